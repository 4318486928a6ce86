// The tree of keys: rows made once and changed in place, branches loaded when they are opened, long ones in pages.
import { Spark } from "./spark.js";
import { ROW } from "./course.js";
import { addressUrl, ageText, bytesText, el, getJson, icon, nameOf, setNumbers, setText, steps, store, stored, toast } from "./util.js";

const PAGE = 100;
const BRANCHES = 90; // the program answers for 100 at a time
const FARTHEST = 1e12; // item of a list that is asked for
const PLAIN = ["int", "float", "bool", "NoneType"];
const RIGHT = "M5 2l6 6-6 6z";

export class Tree {
  // app: what is shown; root: the address of the branch at the top; remember: a name under which open branches are kept.
  constructor(element, app, root, remember) {
    this.element = element;
    this.app = app;
    this.root = root;
    this.remember = remember;
    this.open = new Map([[root, 0], ...(remember ? stored(remember, []) : [])]);
    this.rows = new Map();
    this.pagers = new Map();
    this.levels = new Map();
    this.regular = new Set(); // what was published often: worth a warning when it falls silent
    this.loaded = false;
    element.addEventListener("click", (event) => this.onClick(event));
    element.addEventListener("keydown", (event) => this.onKey(event));
  }

  async refresh(signal) {
    const open = [...this.open].map(([address, start]) => `${PAGE}:${start}:${address}`);
    const { app } = this;
    const answer = await getJson("tree", { at: app.at, since: app.since(), open }, signal);
    app.spanFrom(answer);
    this.branches = new Map(answer.branches.map((branch) => [branch.address, branch]));
    const over = answer.branches.filter((branch) => branch.start > 0 && branch.start >= branch.total); // it has become shorter
    for (const { address } of over) this.open.set(address, 0);
    if (over.length) app.refresh();
    this.elsewhere = this.leaveOut?.(this.branches.get(this.root)?.nodes ?? []) ?? new Set(); // what is shown in another way
    this.loaded = true;
    this.render();
  }

  render() {
    const wanted = [];
    this.collect(this.root, 1, wanted, 0);
    const root = this.branches.get(this.root);
    if (!wanted.length) wanted.push(this.emptiness(root));
    const kept = new Set(wanted);
    // What is gone goes first: a row that is moved would lose the keyboard's focus.
    for (const it of [...this.element.childNodes]) if (!kept.has(it)) it.remove();
    let position = this.element.firstChild;
    for (const it of wanted) {
      if (it === position) position = position.nextSibling;
      else this.element.insertBefore(it, position);
    }
    for (const known of [this.rows, this.pagers]) for (const [address, it] of known) if (!kept.has(it)) known.delete(address);
    this.focusable(wanted);
    if (this.wanted) this.bringIntoView();
  }

  emptiness(root) {
    this.blank ??= el("div", { class: "empty" });
    const text = root?.error ?? "";
    const state = `${text}|${this.app.at === null}|${this.app.config.live}`;
    if (this.blank.dataset.state === state) return this.blank;
    this.blank.dataset.state = state;
    if (text) this.blank.replaceChildren(text);
    else if (this.root) this.blank.replaceChildren("Nothing is in here.");
    else if (this.app.config.live && this.app.at === null) this.blank.replaceChildren("Nothing stored yet; try: ", el("code", {}, "reem set demo 1"));
    else this.blank.replaceChildren("Nothing was stored then.");
    return this.blank;
  }

  collect(address, level, wanted, depth) {
    const branch = this.branches.get(address);
    if (!branch || depth > 100) return;
    branch.nodes.forEach((node, index) => {
      if (this.elsewhere?.has(node.address)) return;
      wanted.push(this.row(node, level, branch, index));
      if (this.open.has(node.address)) this.collect(node.address, level + 1, wanted, depth + 1);
    });
    if (branch.total > branch.nodes.length) wanted.push(this.pager(branch, level));
  }

  row(node, level, branch, index) {
    let row = this.rows.get(node.address);
    if (!row) this.rows.set(node.address, (row = this.newRow(node)));
    row.level = level;
    const container = node.kind === "dict" || node.kind === "list";
    const parts = row.parts;
    this.label(parts, node.label);
    row.classList.toggle("changed", node.mark === "changed");
    row.classList.toggle("inside", node.mark === "inside");
    row.setAttribute("aria-level", level);
    row.setAttribute("aria-setsize", branch.total);
    row.setAttribute("aria-posinset", branch.start + index + 1);
    row.setAttribute("aria-selected", String(node.address === this.app.path));
    parts.key.style.paddingLeft = `${Math.min(level - 1, 12) * 15}px`;
    const foldable = container && node.count > 0;
    parts.twist.hidden = !foldable;
    parts.leaf.hidden = foldable;
    if (foldable) row.setAttribute("aria-expanded", String(this.open.has(node.address)));
    else row.removeAttribute("aria-expanded");
    setNumbers(parts.value, container ? node.text || `${node.count} ${node.kind === "dict" ? (node.count === 1 ? "key" : "keys") : node.count === 1 ? "item" : "items"}` : node.text);
    parts.value.className = `value is-${node.text.startsWith("[") && container ? "float" : node.kind.replace(/\W/g, "")}`;
    row.classList.toggle("raw", Boolean(node.raw) && this.root === "" && level === 1);
    const mark = new Map([["changed", "changed"], ["inside", "something in it changed"]]).get(node.mark);
    parts.key.title = [node.raw ? `${node.label}: another program's ${node.raw}` : node.label, mark && `${mark} ${this.app.sinceText()}`].filter(Boolean).join("\n");
    parts.value.title = `${nameOf(node.kind)}  ${node.text}`;
    setText(parts.size, PLAIN.includes(node.kind) ? "" : bytesText(node.size));
    parts.spark.show(node, this.app.now());
    this.age(parts.age, node);
    return row;
  }

  age(it, node) {
    if (node.rate >= 2) this.regular.add(node.address);
    const seconds = node.time === null ? null : Math.max(this.app.now() - node.time, 0);
    setText(it, node.rate >= 2 ? `${Math.round(node.rate)} Hz` : seconds === null ? "–" : ageText(seconds));
    it.classList.toggle("stale", this.regular.has(node.address) && !node.rate && seconds > 5);
    const changed = seconds === null ? "not seen to change yet" : `changed ${ageText(seconds)}${seconds < 1 ? "" : " ago"}`;
    it.title = node.rate >= 2 ? `${node.rate.toFixed(1)} updates per second, ${changed}` : changed;
  }

  // A row is used again where the same place is found by a search, there with its whole path.
  label(parts, label) {
    if (parts.name.textContent === label) return;
    parts.name.textContent = parts.key.title = label;
    parts.twist.setAttribute("aria-label", `Open or close ${label}`);
  }

  newRow(node) {
    const twist = el("button", { class: "twist", tabIndex: -1, type: "button" }, icon(RIGHT));
    const leaf = el("span", { class: "leaf" }), name = el("bdi");
    const key = el("span", { class: "key" }, twist, leaf, name);
    const value = el("bdi", { class: "value" }), size = el("span"), age = el("span", { class: "age" });
    const spark = new Spark();
    const row = el("div", { class: "row", role: "treeitem", tabIndex: -1, title: "", draggable: true, ondragstart: (event) => event.dataTransfer.setData(ROW, node.address) }, key, value, el("span", { class: "size" }, size, spark.canvas), age);
    row.parts = { key, name, twist, leaf, value, size, spark, age };
    row.address = node.address;
    row.dataset.address = node.address;
    return row;
  }

  pager(branch, level) {
    const end = branch.start + branch.nodes.length;
    let it = this.pagers.get(branch.address);
    if (!it) {
      const turn = (step) => () => { this.open.set(branch.address, Math.max(0, (this.open.get(branch.address) ?? 0) + step)); this.save(); this.app.refresh(); };
      const back = el("button", { type: "button", onclick: turn(-PAGE) }, `‹ ${PAGE}`), forth = el("button", { type: "button", onclick: turn(PAGE) }, `${PAGE} ›`);
      it = el("div", { class: "pager more" }, back, el("span"), forth);
      it.parts = { back, text: it.children[1], forth };
      this.pagers.set(branch.address, it);
    }
    it.style.paddingLeft = `${Math.min(level - 1, 12) * 15 + 30}px`;
    setText(it.parts.text, `${(branch.start + 1).toLocaleString()}–${end.toLocaleString()} of ${branch.total.toLocaleString()}`);
    it.parts.back.disabled = branch.start === 0;
    it.parts.forth.disabled = end >= branch.total;
    return it;
  }

  focusable(wanted) {
    const rows = wanted.filter((it) => it.address !== undefined);
    const current = rows.find((row) => row.tabIndex === 0) ?? rows.find((row) => row.address === this.app.path) ?? rows[0];
    if (current) current.tabIndex = 0;
  }

  // Open the branches above an address, so that its row is there, and bring it into view once it is drawn.
  reveal(address) {
    const above = steps(address);
    above.forEach((step, index) => {
      if (index < above.length - 1 && !this.open.has(step.address) && this.open.size < BRANCHES) this.open.set(step.address, 0);
      const item = /^\[(\d+)\]$/.exec(above[index + 1]?.part ?? "");
      if (item && this.open.has(step.address)) this.open.set(step.address, Math.floor(Math.min(Number(item[1]), FARTHEST) / PAGE) * PAGE);
    });
    this.save();
    this.wanted = address;
  }

  bringIntoView() {
    const row = this.rows.get(this.wanted);
    if (!row) return;
    this.wanted = null;
    const box = row.getBoundingClientRect(), around = this.element.getBoundingClientRect();
    if (box.height && (box.top < around.top || box.bottom > around.bottom)) row.scrollIntoView({ block: "center" });
  }

  save() {
    if (this.remember) store(this.remember, [...this.open].filter(([address]) => address !== this.root).slice(0, 80));
  }

  toggle(address, open = !this.open.has(address)) {
    if (open && this.open.size >= BRANCHES) return toast(`${BRANCHES} branches are open: close one first`);
    if (open) this.open.set(address, 0);
    else this.open.delete(address);
    this.save();
    return this.app.refresh();
  }

  onClick(event) {
    const row = event.target.closest(".row");
    if (!row) return;
    this.focus(row);
    if (event.target.closest(".twist")) return this.toggle(row.address);
    if (event.ctrlKey || event.metaKey) return window.open(addressUrl(row.address));
    if (row.getAttribute("aria-expanded") === "false") this.toggle(row.address, true);
    this.app.go(row.address);
  }

  focus(row) {
    for (const each of this.element.querySelectorAll('.row[tabindex="0"]')) each.tabIndex = -1;
    row.tabIndex = 0;
    row.focus({ preventScroll: false });
  }

  onKey(event) {
    const row = event.target.closest?.(".row");
    if (!row || event.ctrlKey || event.metaKey || event.altKey) return;
    const rows = [...this.element.querySelectorAll(".row")], index = rows.indexOf(row);
    if (event.key === "ArrowDown" && rows[index + 1]) this.focus(rows[index + 1]);
    else if (event.key === "ArrowUp" && rows[index - 1]) this.focus(rows[index - 1]);
    else if (event.key === "Enter") this.app.go(row.address);
    else if (event.key === "+" && row.getAttribute("aria-expanded") === "false") this.toggle(row.address, true);
    else if (event.key === "-" && row.getAttribute("aria-expanded") === "true") this.toggle(row.address, false);
    else if (!["ArrowDown", "ArrowUp", "+", "-"].includes(event.key)) return;
    event.preventDefault();
    event.stopPropagation();
  }
}
