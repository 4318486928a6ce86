// Arrays: as an image, as lines, as a table, as a histogram; a part of them where there are more than two axes.
import { Course } from "./course.js";
import { Overlay, overlayField } from "./overlay.js";
import { Plot } from "./plot.js";
import { el, getJson, getPicture, numberEl, setNumbers, setText, swap, toast } from "./util.js";

const TITLES = { image: "Image", line: "Lines", table: "Table", histogram: "Histogram" };
const VECTOR = 16; // items
const ROWS = 50, COLUMNS = 16;
const NO_PIXEL = "Point at the picture to read a value.";
const MOST_FREE = { image: 3, line: 2, table: 2, histogram: 64 };

export class ArrayView {
  constructor(parent, app, address) {
    Object.assign(this, { parent, app, address, view: null, slices: {}, options: { map: null, low: "", high: "", bgr: false }, row: 0, column: 0 });
    this.tabs = el("div", { class: "tabs", role: "tablist", "aria-label": "Ways to show it" });
    this.tools = el("div", { class: "tools" });
    this.stage = el("div", { class: "card", role: "tabpanel" });
    this.late = el("p", { class: "hint", hidden: true });
    this.facts = el("dl", { class: "facts" });
    parent.append(this.tabs, this.tools, this.late, this.stage, this.facts); // how old it is stands above: below a tall picture nobody sees it
    this.parent = parent;
  }

  async update(node, signal) {
    const about = await getJson("array", { path: this.address, at: this.app.at }, signal);
    if (!this.about) this.build(about);
    this.about = about;
    await this.show(signal);
    if (about.shape.length !== 1 || about.shape[0] > VECTOR) return;
    this.course ??= new Course(this.parent, this.app, this.address); // a small vector is drawn over time as well
    await this.course.update(signal);
  }

  build(about) {
    this.slices = { ...about.views };
    this.options.map = about.dtype === "uint8" || about.dtype === "bool" ? "grey" : "viridis";
    for (const name of ["image", "line", "table", "histogram"].filter((each) => each in about.views)) {
      const tab = el("button", { type: "button", role: "tab", id: `tab-${name}`, onclick: () => this.choose(name, about) }, TITLES[name]);
      this.tabs.append(tab);
    }
    this.tabs.addEventListener("keydown", (event) => this.onKey(event));
    if (about.view) this.choose(about.view, about, false);
    else this.stage.replaceChildren(el("p", { class: "empty" }, "This array has no items."));
  }

  onKey(event) {
    const tabs = [...this.tabs.children], step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    const next = tabs[(tabs.indexOf(event.target) + step + tabs.length) % tabs.length];
    next.click();
    next.focus();
    event.preventDefault();
    event.stopPropagation();
  }

  choose(name, about, refresh = true) {
    this.view = name;
    for (const tab of this.tabs.children) {
      const here = tab.id === `tab-${name}`;
      tab.setAttribute("aria-selected", String(here));
      tab.tabIndex = here ? 0 : -1;
    }
    this.stage.setAttribute("aria-labelledby", `tab-${name}`);
    this.tools.replaceChildren(...this.axes(about), ...(name === "image" ? this.imageTools(about) : []));
    this.stage.replaceChildren();
    this[`${name}Stage`]();
    if (refresh) this.app.refresh();
  }

  // One box for each axis: a number, or a colon for all of it.
  axes(about) {
    if (about.shape.length < 2) return [];
    const boxes = about.shape.map((size, axis) => {
      const box = el("input", { type: "text", class: "axis", value: this.slices[this.view].split(",")[axis], title: `axis ${axis}, ${size} items`, "aria-label": `Axis ${axis} of ${size} items: an index, or a colon for all` });
      const apply = () => this.slice(boxes.map((each) => each.value.trim() || ":"), about);
      box.addEventListener("change", apply);
      box.addEventListener("keydown", (event) => {
        const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
        if (!step || box.value.trim() === ":") return;
        box.value = String(Math.min(Math.max((Number(box.value) || 0) + step, 0), size - 1));
        event.preventDefault();
        apply();
      });
      return box;
    });
    return [el("label", {}, "slice ["), ...boxes, el("span", {}, "]")];
  }

  slice(words, about) {
    const free = words.filter((word) => word === ":").length;
    const wrong = words.find((word, axis) => word !== ":" && !(/^-?\d+$/.test(word) && Number(word) < about.shape[axis] && Number(word) >= -about.shape[axis]));
    if (wrong !== undefined) return toast(`“${wrong}” is neither : nor an index within the axis`);
    if (free > MOST_FREE[this.view]) return toast(`At most ${MOST_FREE[this.view]} axes can be shown here; use an index for the others`);
    this.slices[this.view] = words.join(",");
    this.row = this.column = 0;
    return this.app.refresh();
  }

  imageTools(about) {
    const { options } = this, again = () => this.app.refresh();
    const map = el("select", { onchange: () => { options.map = map.value; again(); } }, ...about.maps.map((name) => el("option", { value: name, selected: name === options.map }, name)));
    const limit = (name) => {
      const box = el("input", { type: "text", inputMode: "decimal", placeholder: "auto", value: options[name], "aria-label": `${name} end of the range`,
        onchange: () => { if (box.value.trim() && !Number.isFinite(Number(box.value))) return toast("Not a number"); options[name] = box.value.trim(); return again(); } });
      return box;
    };
    const bgr = el("input", { type: "checkbox", checked: options.bgr, onchange: () => { options.bgr = bgr.checked; again(); } });
    this.mapLabel = el("label", {}, "colours ", map);
    this.bgrLabel = el("label", {}, bgr, "BGR");
    return [this.mapLabel, el("label", {}, "range ", limit("low"), " … ", limit("high")), this.bgrLabel, overlayField(this.app, this.address)];
  }

  // What came with a view: figures of the very array that is shown, and how old it is.
  tell(said) {
    const { statistics } = said, pairs = [["smallest", statistics.low], ["largest", statistics.high], ["mean", statistics.mean], ["NaN or infinite", statistics.bad || undefined]];
    this.facts.replaceChildren(...pairs.filter(([, value]) => value !== undefined).map(([name, value]) => el("div", {}, el("dt", {}, name), numberEl("dd", String(value)))));
    const words = [];
    if (said.preview) words.push("A small picture of it is kept: colours and edges are not exact.");
    if (said.age !== null && said.age > 0.0005) words.push(`From ${said.age.toFixed(2)} s before this instant${said.late > 0.5 ? "; newer ones are not kept" : ""}.`);
    else if (said.late > 0.0005) words.push(`Newer ones, up to ${said.late.toFixed(2)} s later, are not kept.`);
    this.late.hidden = !words.length;
    setText(this.late, words.join(" "));
  }

  async show(signal) {
    if (!this.view) return;
    const values = { path: this.address, at: this.app.at, slice: this.slices[this.view] };
    if (!this.about.shape.length) values.slice = null;
    await this[`${this.view}Show`](values, signal);
  }

  imageStage() {
    this.img = el("img", { alt: `Picture of the array at ${this.address}` });
    this.scale = el("canvas", { width: 256, height: 1 });
    this.scaleShown = null;
    this.lowText = el("span");
    this.highText = el("span");
    this.scaleBox = el("div", { class: "scale" }, this.lowText, this.scale, this.highText);
    this.bad = el("p", { class: "hint", hidden: true });
    this.pixel = el("p", { class: "pixel", role: "status" }, NO_PIXEL);
    this.img.addEventListener("pointermove", (event) => this.point(event));
    this.img.addEventListener("pointerleave", () => { this.pointed = null; setText(this.pixel, NO_PIXEL); });
    this.stage.append(el("div", { class: "picture" }, this.img), this.pixel, this.scaleBox, this.bad);
    this.overlay = new Overlay(this.img, this.app, this.address);
    this.pixel.before(this.overlay.wrong);
  }

  point(event) {
    const box = this.img.getBoundingClientRect(), [width, height] = this.size ?? [0, 0];
    const at = (part, count) => Math.min(Math.max(Math.floor(part * count), 0), count - 1);
    this.pointed = [at((event.clientY - box.top) / box.height, height), at((event.clientX - box.left) / box.width, width)];
    if (width && !this.asking) this.readPixel();
  }

  // The value under the pointer, one request at a time: the last place is asked for again if it moved meanwhile.
  async readPixel() {
    this.asking = true;
    try {
      while (this.pointed && this.view === "image") {
        const [row, column] = this.pointed, free = [row, column];
        const slice = this.slices.image.split(",").map((word) => (word === ":" && free.length ? free.shift() : word)).join(",");
        let text = "";
        try {
          const { cells } = await getJson("table", { path: this.address, at: this.app.at, slice });
          text = cells.length > 1 ? `[${cells.map(([cell]) => cell).join(", ")}]` : cells[0][0];
        } catch (error) {
          text = error.message;
        }
        if (!this.pointed) break;
        setText(this.pixel, `row ${row}, column ${column}: ${text}`);
        if (this.pointed[0] === row && this.pointed[1] === column) break;
      }
    } finally {
      this.asking = false;
    }
  }

  async imageShow(values, signal) {
    const { map, low, high, bgr } = this.options;
    const side = Math.min(Math.ceil(Math.max(this.stage.clientWidth, 320) * (window.devicePixelRatio || 1)), 2048);
    const { blob, said } = await getPicture("image", { ...values, map, low, high, bgr: bgr ? 1 : null, side }, signal);
    if (this.view !== "image") return;
    this.tell(said);
    await swap(this.img, blob);
    const [width, height] = (this.size = said.size);
    // The size is that of the array, not of the picture: nothing jumps when another picture comes.
    const fit = Math.min(this.stage.clientWidth / width, (0.6 * window.innerHeight) / height) * 0.96;
    const factor = fit < 1 ? fit : Math.max(1, Math.min(Math.floor(fit), Math.floor(560 / Math.max(width, height))));
    this.img.classList.toggle("small", factor > 2);
    this.img.style.width = `${Math.max(width * factor, 1)}px`;
    this.img.style.height = `${Math.max(height * factor, 1)}px`;
    await this.overlay.update(said.size, signal);
    const colour = this.slices.image.split(",").filter((word) => word === ":").length === 3 && this.about.shape[this.about.shape.length - 1] > 1;
    this.mapLabel.hidden = colour;
    this.bgrLabel.hidden = !colour;
    this.scaleBox.hidden = colour;
    setNumbers(this.lowText, String(said.low));
    setNumbers(this.highText, String(said.high));
    await this.drawScale(map, signal);
    this.bad.hidden = !said.bad;
    setText(this.bad, `${said.bad.toLocaleString()} are NaN or infinite: magenta.`);
  }

  // The colours come from the program, as a picture of a ramp would: they are asked for once.
  async drawScale(map, signal) {
    if (this.scaleShown === map) return;
    const colours = await getJson("colours", { map }, signal);
    const context = this.scale.getContext("2d");
    colours.forEach((colour, index) => { context.fillStyle = colour; context.fillRect(index * (256 / colours.length), 0, 256 / colours.length + 1, 1); });
    this.scaleShown = map;
  }

  lineStage() {
    this.plot = new Plot(this.stage);
    this.more = el("p", { class: "hint", hidden: true });
    this.stage.append(this.more);
  }

  async lineShow(values, signal) {
    const data = await getJson("line", values, signal);
    if (this.view !== "line") return;
    this.tell(data);
    this.plot.set(data);
    this.more.hidden = !data.more;
    setText(this.more, `${data.more} more columns are not drawn.`);
  }

  histogramStage() { this.plot = new Plot(this.stage, { label: "Histogram", bars: true }); }

  async histogramShow(values, signal) {
    const data = await getJson("histogram", values, signal);
    if (this.view !== "histogram") return;
    this.tell(data);
    const { low, high, counts } = data, each = (high - low) / Math.max(counts.length, 1);
    this.plot.set({ names: [""], times: counts.map((_, index) => low + index * each), lines: [counts], start: low, end: high });
  }

  tableStage() {
    this.table = el("table");
    const turn = (name, step) => () => { this[name] = Math.max(0, this[name] + step); this.app.refresh(); };
    const button = (text, title, act) => el("button", { type: "button", title, "aria-label": title, onclick: act }, text);
    this.rowText = el("span");
    this.columnText = el("span");
    this.turns = { up: button("‹", "Rows before", turn("row", -ROWS)), down: button("›", "Rows after", turn("row", ROWS)), left: button("‹", "Columns before", turn("column", -COLUMNS)), right: button("›", "Columns after", turn("column", COLUMNS)) };
    const { up, down, left, right } = this.turns;
    const jump = el("input", { type: "text", class: "axis", inputMode: "numeric", "aria-label": "Go to row", onchange: () => { this.row = Math.max(0, Math.floor(Number(jump.value)) || 0); this.app.refresh(); } });
    this.columnBox = el("span", { class: "row2" }, left, this.columnText, right);
    this.pager = el("div", { class: "pager tools" }, up, this.rowText, down, el("label", {}, "go to row ", jump), this.columnBox);
    this.stage.append(el("div", { class: "tablebox", tabIndex: 0, role: "region", "aria-label": "Table" }, this.table), this.pager);
  }

  async tableShow(values, signal) {
    const { row, column } = this;
    const data = await getJson("table", { ...values, row, column, rows: ROWS, columns: COLUMNS }, signal);
    if (this.row !== row || this.column !== column || this.view !== "table") return; // another page was asked for meanwhile
    this.tell(data);
    const [rows, columns] = data.shape;
    this.row = data.row;
    this.column = data.column;
    const head = el("tr", {}, el("th", { scope: "col" }), ...Array.from({ length: data.columns }, (_, index) => el("th", { scope: "col" }, String(data.column + index))));
    const body = data.cells.map((cells, index) => el("tr", {}, el("th", { scope: "row" }, String(data.row + index)), ...cells.map((cell) => numberEl("td", cell))));
    this.table.replaceChildren(el("thead", {}, head), el("tbody", {}, ...body));
    const span = (start, count, all) => `${start.toLocaleString()}–${(start + count - 1).toLocaleString()} of ${all.toLocaleString()}`;
    setText(this.rowText, `rows ${span(data.row, data.cells.length, rows)}`);
    setText(this.columnText, `columns ${span(data.column, data.columns, columns)}`);
    const { up, down, left, right } = this.turns;
    up.disabled = data.row === 0;
    down.disabled = data.row + data.cells.length >= rows;
    left.disabled = data.column === 0;
    right.disabled = data.column + data.columns >= columns;
    this.columnBox.hidden = columns <= COLUMNS;
    this.pager.hidden = rows <= ROWS && columns <= COLUMNS;
  }
}
