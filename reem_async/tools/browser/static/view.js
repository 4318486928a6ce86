// The value: what is at the chosen path, drawn anew when its type changes and brought up to date when it does not.
import { ArrayView } from "./arrays.js";
import { Course } from "./course.js";
import { Home } from "./home.js";
import { isNumber, MOST, Panes } from "./panes.js";
import { Parameters } from "./parameters.js";
import { Tree } from "./tree.js";
import { addressUrl, ageText, bodyOf, bytesText, copy, el, fetched, getJson, getPicture, nameOf, postWrite, query, setNumbers, setText, steps, swap, toast, visible } from "./util.js";

const LONGEST = 16; // items of a list that are drawn over time
const SCALARS = ["str", "int", "float", "bool", "NoneType"];
const NUMBERS = ["int", "float", "bool"];

export class View {
  constructor(element, app) {
    this.element = element;
    this.app = app;
    this.address = "";
  }

  show(address) {
    this.address = address;
    this.shape = null;
    this.body = null;
    this.stop?.abort();
    this.stop = new AbortController();
    if (address) return;
    this.element.replaceChildren();
    this.home = new Home(this.element, this.app);
  }

  concerns(addresses) {
    const { address } = this;
    return address === "" || addresses.some((each) => address.startsWith(each) || each.startsWith(address));
  }

  async refresh() {
    const { address, app } = this, signal = this.stop?.signal;
    if (!address) {
      if (this.element.getClientRects().length) await this.home.update(signal); // a phone shows the keys only
      return;
    }
    try {
      const node = await getJson("node", { path: address, at: app.at }, signal);
      if (address !== this.address) return;
      if (node.address !== address) { app.go(node.address, false); history.replaceState(null, "", app.url()); return; }
      const shape = `${NUMBERS.includes(node.kind) ? "number" : node.kind}|${node.kind === "numpy" ? node.text : ""}`;
      const kept = app.at === null && this.editor?.open && this.shape !== "missing" && shape !== this.shape; // what is being typed is not lost
      if (shape !== this.shape && !kept) this.build(node, shape);
      this.facts(node);
      this.main.classList.remove("gone");
      this.note.hidden = !kept;
      if (kept) setText(this.note, `It is ${nameOf(node.kind)} now: ${node.text}. It is shown again once Edit is closed.`);
      else await this.body.update(node, signal);
      await this.parameters.update(signal);
    } catch (error) {
      if (error.name === "AbortError" || address !== this.address) return;
      if (![400, 404, 409, 422].includes(error.status)) throw error;
      this.missing(error.message);
    }
  }

  // What is there no longer, or not yet, or not kept: the page stays as it is, with a note above it.
  missing(message) {
    if (!this.body || this.shape === "missing") {
      this.shape = "missing";
      this.frame(null);
      this.body = { update: () => {} };
    }
    setText(this.note, message);
    this.note.hidden = false;
    setText(this.what, "");
    this.main.classList.add("gone");
  }

  frame(node) {
    const crumbs = steps(this.address).map(({ part, address }) => {
      const name = el("bdi", {}, visible(part));
      return address === this.address ? name : el("a", { class: "crumb", href: addressUrl(address), "data-go": address }, name);
    });
    this.what = el("span", { class: "what" });
    this.note = el("p", { class: "note", role: "status", hidden: true });
    this.main = el("div");
    this.parameters = new Parameters(this.app, this.address);
    this.element.replaceChildren(
      el("div", { class: "head" }, el("a", { class: "back", href: "/", "data-go": "" }, "‹ all keys"), el("h1", {}, ...crumbs), this.what, this.pinButton()),
      this.note, this.parameters.element, this.main, ...(node ? this.extras(node) : []));
  }

  pinButton() {
    const { layout } = this.app;
    const show = () => {
      const pinned = layout.has(this.address);
      setText(button, pinned ? "Unpin" : "Pin");
      button.title = pinned ? "Take it off the first page" : "Show it on the first page";
      button.setAttribute("aria-pressed", String(pinned));
    };
    const button = el("button", { type: "button", class: "quiet pinned", onclick: () => { layout.toggle(this.address); show(); } });
    show();
    return button;
  }

  build(node, shape) {
    this.shape = shape;
    this.frame(node);
    const make = BODIES.get(node.kind) ?? PlainBody;
    this.body = new make(this.main, this.app, this.address);
  }

  facts(node) {
    const items = node.kind === "dict" || node.kind === "list" ? `${node.count} ${node.count === 1 ? "item" : "items"}` : "", size = [items, bytesText(node.size)].filter(Boolean).join(" · ");
    const age = node.time === null ? "" : ageText(Math.max(this.app.now() - node.time, 0));
    const words = [nameOf(node.kind), node.kind === "numpy" ? node.text : "", SCALARS.includes(node.kind) && node.kind !== "str" ? "" : size];
    if (node.raw) words.push(`another program's ${node.raw}`);
    if (node.rate >= 2) words.push(`${Math.round(node.rate)} Hz`);
    if (age) words.push(age === "now" ? "changed now" : `changed ${age} ago`);
    setText(this.what, words.filter(Boolean).join(" · "));
    this.node = node;
    if (this.editor) this.editor.hidden = this.app.at !== null;
    this.snippet?.(node.snippets ?? {});
  }

  extras(node) {
    const extras = [];
    this.editor = this.snippet = null;
    if (this.app.config.write && [...SCALARS, "dict", "list"].includes(node.kind) && node.editable !== false) extras.push((this.editor = this.editCard()));
    if (Object.keys(node.snippets ?? {}).length) extras.push(this.snippetCard(node.snippets));
    return extras;
  }

  snippetCard(snippets) {
    const names = Object.keys(snippets), code = el("pre", {}, snippets[names[0]]);
    this.snippet = (newer) => { snippets = newer; setText(code, snippets[choose.value] ?? ""); };
    const choose = el("select", { "aria-label": "Front", onchange: () => { code.textContent = snippets[choose.value]; } }, ...names.map((name) => el("option", { value: name }, name)));
    return el("details", { class: "card" }, el("summary", {}, "Read it with Python"),
      el("div", { class: "tools" }, choose), el("div", { class: "snippet" }, code, el("button", { type: "button", onclick: () => copy(code.textContent) }, "Copy")));
  }

  editCard() {
    const area = el("textarea", { "aria-label": "New value, as JSON", spellcheck: false, rows: 3, "aria-describedby": "edit-wrong", oninput: () => this.complain("") });
    const write = el("button", { type: "button", class: "primary", onclick: () => this.write(area.value) }, "Write…");
    this.wrong = el("p", { class: "wrong", id: "edit-wrong", role: "alert", hidden: true });
    this.area = area;
    const card = el("details", { class: "card edit", ontoggle: () => card.open ? this.attempt(async () => { area.value = await this.jsonText(); }) : this.app.refresh() },
      el("summary", {}, "Edit"), area, this.wrong, el("div", { class: "tools" }, write, el("span", {}, "JSON, such as 1.5, true, \"text\" or {\"a\": [1, 2]}")));
    return card;
  }

  async jsonText() {
    if (SCALARS.includes(this.node.kind) && this.node.kind !== "str") return this.node.text;
    return bodyOf(await fetched(`/api/json?${query({ path: this.address })}`), "text");
  }

  // What is wrong with what is in the field is said beside it, until it is changed.
  complain(text) {
    setText(this.wrong, text);
    this.wrong.hidden = !text;
    this.area.setAttribute("aria-invalid", String(Boolean(text)));
  }

  async attempt(work) {
    try {
      return await work();
    } catch (error) {
      this.complain(error.message);
      return undefined;
    }
  }

  async write(text) {
    this.complain("");
    try {
      JSON.parse(text);
    } catch (error) {
      this.complain(`Not JSON: ${error.message}`);
      return;
    }
    const before = await this.attempt(() => this.jsonText());
    if (before === undefined) return;
    const change = { path: visible(this.address), old: before.slice(0, 2000), new: text.slice(0, 2000) };
    if (!(await confirmed({ ...change, title: "Write this value?", yes: "Write", hint: "It is published: programs that follow this key learn of it at once." }))) return;
    await this.attempt(async () => {
      const send = async (retype) => bodyOf(await postWrite(this.address, text, this.app.config.key, "write", retype), "json");
      const { retyped } = await send(false);
      const hint = `Nothing is written yet. Another type: ${retyped?.join("; ")}. Programs that read it may stop.`;
      if (retyped && !(await confirmed({ ...change, title: "Change the type?", yes: "Change the type", hint }))) return;
      if (retyped) await send(true);
      toast("Written");
      this.app.refresh();
    });
  }
}

// Ask, and return whether the answer is yes.
async function confirmed(texts) {
  const dialog = document.getElementById("confirm");
  for (const [name, text] of Object.entries(texts)) document.getElementById(`confirm-${name}`).textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  await new Promise((done) => dialog.addEventListener("close", done, { once: true }));
  return dialog.returnValue === "yes";
}

class NumberBody {
  constructor(parent, app, address) {
    this.big = el("div", { class: "big" });
    parent.append(this.big);
    this.course = new Course(parent, app, address);
  }

  async update(node, signal) {
    this.big.className = `big is-${node.kind}`;
    setNumbers(this.big, node.text);
    await this.course.update(signal);
  }
}

class PlainBody {
  constructor(parent) {
    this.big = el("div", { class: "big is-NoneType" });
    parent.append(this.big);
  }

  update(node) { setText(this.big, node.text || node.kind); }
}

class TextBody {
  constructor(parent) {
    this.text = el("pre", { class: "text card is-str", dir: "auto" });
    this.cut = el("p", { class: "hint", hidden: true }, "Only the beginning is shown.");
    parent.append(this.text, this.cut);
  }

  update(node) {
    setText(this.text, node.full || " ");
    this.cut.hidden = !node.cut;
  }
}

class TreeBody {
  constructor(parent, app, address) {
    const rows = el("div", { class: "subtree", role: "tree", "aria-label": `Inside ${address}` });
    this.card = el("div", { class: "card" }, rows);
    parent.append(this.card);
    this.tree = new Tree(rows, app, address, null);
  }

  async update(node, signal) { await this.tree.refresh(signal); }
}

// Pictures and plots of what is in a dict side by side, and rows for the rest.
class DictBody {
  constructor(parent, app, address) {
    this.panes = new Panes(parent, app, (each) => each.slice(address.length).replace(/^\./, ""));
    this.rest = new TreeBody(parent, app, address);
    this.rest.tree.leaveOut = (nodes) => {
      const few = nodes.filter(isNumber).length <= MOST; // more numbers are better off as rows
      this.drawn = this.panes.choose(few ? nodes : nodes.filter((each) => !isNumber(each)));
      return new Set(this.drawn.map((each) => each.address));
    };
  }

  async update(node, signal) {
    await this.rest.update(node, signal);
    this.rest.card.hidden = this.drawn.length > 0 && this.drawn.length === node.count;
    await this.panes.update(this.drawn, signal);
  }
}

class ListBody {
  constructor(parent, app, address) {
    this.course = new Course(parent, app, address);
    this.tree = new TreeBody(parent, app, address);
  }

  async update(node, signal) {
    if (node.count <= LONGEST) await this.course.update(signal);
    else this.course.card.hidden = true;
    await this.tree.update(node, signal);
  }
}

class BytesBody {
  constructor(parent, app, address) {
    this.app = app;
    this.address = address;
    this.image = el("img", { alt: `Picture at ${address}` });
    this.picture = el("div", { class: "picture", hidden: true }, this.image);
    this.dump = el("pre", { class: "bytes" });
    this.hex = el("details", { class: "card", open: true }, el("summary", {}, "Bytes"), this.dump);
    this.wrong = el("p", { class: "wrong", role: "alert", hidden: true });
    const hint = el("input", { type: "text", size: 24, "aria-label": "What these bytes are", placeholder: "uint8[480,640,3]", title: "Type and shape, then +N for an offset in bytes: float32[7]+8" });
    this.hint = el("form", { class: "tools hint-form", hidden: true, onsubmit: (event) => { event.preventDefault(); this.say(hint.value); } }, el("label", {}, "Show as ", hint), el("button", { type: "submit" }, "Show"));
    parent.append(this.picture, this.hint, this.wrong, this.hex);
  }

  // What packed bytes are, the page cannot know: it is said once, and holds for all pages of this program.
  async say(text) {
    try {
      await postWrite(this.address, JSON.stringify(text), this.app.config.key, "hint");
      this.wrong.hidden = true;
      this.app.refresh();
    } catch (error) {
      setText(this.wrong, error.message);
      this.wrong.hidden = false;
    }
  }

  async update(node, signal) {
    const values = { path: this.address, at: this.app.at };
    const said = await getJson("bytes", values, signal);
    setText(this.dump, said.rows.map(([at, hex, text]) => `${at}  ${hex.padEnd(47)}  ${text}`).join("\n") + (said.bytes > 1024 ? "\n…" : ""));
    if (this.picture.hidden === said.picture) this.hex.open = !said.picture;
    this.picture.hidden = !said.picture;
    this.hint.hidden = said.picture || !this.app.config.live || !node.raw;
    if (!said.picture) return;
    const { blob } = await getPicture("picture", values, signal);
    await swap(this.image, blob);
  }
}

const BODIES = new Map([["dict", DictBody], ["list", ListBody], ["str", TextBody], ["bytes", BytesBody], ["jpeg", BytesBody], ["numpy", ArrayView], ["png", ArrayView], ["int", NumberBody], ["float", NumberBody], ["bool", NumberBody]]);
