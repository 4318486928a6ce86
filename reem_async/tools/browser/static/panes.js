// Panes: pictures and plots side by side, of what is in a dict, or of what is busy or pinned.
import { Course } from "./course.js";
import { Overlay } from "./overlay.js";
import { Plot } from "./plot.js";
import { addressUrl, el, getJson, getPicture, icon, setNumbers, setText, swap } from "./util.js";

export const MOST = 12; // panes at a time
const PAUSE = 1000; // ms between two looks at a course: a dozen of them cost the program as much as one in full
const PIN = "M5.5 1.5h5l-.8 4.5 2.3 2.5H8.6V14L8 15l-.6-1V8.5H4l2.3-2.5z";
const LEAST_PICTURE = 64; // numbers of an array that is worth a picture of its own
const SHORT = 16; // numbers of a vector that are drawn over time

class Pane {
  constructor(grid, node) {
    const { address } = node;
    Object.assign(this, { grid, address });
    const { app } = grid;
    this.value = el("span", { class: "pane-value" });
    this.pin = el("button", { class: "quiet pin", type: "button", onclick: () => { app.layout.toggle(address); this.showPin(); grid.onPin?.(); } }, icon(PIN));
    const title = el("a", { href: addressUrl(address), "data-go": address, title: address, draggable: false }, el("bdi", {}, grid.label(address)));
    this.head = el("div", { class: "pane-head", draggable: true, title: "Drag to move" }, title, this.value, this.pin);
    this.body = el("div", { class: "pane-body" });
    this.element = el("div", { class: `pane card${isPicture(node) ? " of-picture" : ""}` }, this.head, this.body);
    this.element.address = address;
    this.showPin();
  }

  showPin() {
    const pinned = this.grid.app.layout.has(this.address), says = pinned ? "Take off the first page" : "Show on the first page";
    this.pin.setAttribute("aria-pressed", String(pinned));
    this.pin.setAttribute("aria-label", `${says}: ${this.address}`);
    this.pin.title = says;
  }

  async update(node, signal) {
    setNumbers(this.value, isNumber(node) ? node.text : ""); // a legend says the rest
    if (node.kind !== "numpy" || /^\w+\[\d{1,2}\]$/.test(node.text)) return this.begin("course").course(signal);
    const shape = node.text;
    if (this.shape !== shape) {
      this.about = await getJson("array", { path: this.address, at: this.grid.app.at }, signal);
      this.shape = shape;
    }
    if (this.about.view === "line") return this.begin("line").curves(signal); // a path of many points, two numbers each
    return this.about.views.image ? this.begin("image").show(signal) : undefined;
  }

  // What is drawn of another kind of value does not stay beside it.
  begin(what) {
    if (this.drawn !== what) {
      this.body.replaceChildren();
      this.picture = this.plot = null;
    }
    this.drawn = what;
    return this;
  }

  async curves(signal) {
    if (!this.plot) {
      const card = el("div", { class: "small-plot" });
      this.body.append(card);
      this.plot = new Plot(card, { label: `Lines of the array at ${this.address}` });
    }
    this.plot.set(await getJson("line", { path: this.address, at: this.grid.app.at, slice: this.about.views.line }, signal));
  }

  course(signal) {
    this.plot ??= new Course(this.body, this.grid.app, this.address, { pause: PAUSE, small: true });
    return this.plot.update(signal);
  }

  async show(signal) {
    if (!this.picture) {
      this.picture = el("img", { alt: `Picture of the array at ${this.address}` });
      this.age = el("span", { class: "pane-age" });
      this.body.append(el("a", { class: "picture", href: addressUrl(this.address), "data-go": this.address, draggable: false }, this.picture), this.age);
      this.overlay = new Overlay(this.picture, this.grid.app, this.address);
      this.body.append(this.overlay.wrong);
    }
    const { app } = this.grid, map = ["uint8", "bool"].includes(this.about.dtype) ? "grey" : "viridis";
    const { blob, said } = await getPicture("image", { path: this.address, at: app.at, slice: this.about.views.image, map, side: 480, coarse: 1 }, signal);
    await swap(this.picture, blob);
    await this.overlay.update(said.size, signal);
    setText(this.age, said.age > 0.5 ? `from ${said.age.toFixed(1)} s before` : "");
  }
}

function isPicture(node) {
  const shape = node.kind === "numpy" && /^\w+\[((?:\d+, ?)+\d+)\]$/.exec(node.text);
  return Boolean(shape) && shape[1].split(",").reduce((product, size) => product * size, 1) >= LEAST_PICTURE;
}

export function isNumber(node) { return node.kind === "int" || node.kind === "float"; }

// What can be drawn of a node: a picture or a plot of what has changed. All else is a row.
function drawable(node) {
  if (node.kind === "numpy") return isPicture(node) || (/^[a-z]+\d*\[\d{1,2}\]$/.test(node.text) && Number(/\d+(?=\]$)/.exec(node.text)[0]) <= SHORT);
  if (node.kind === "list") return node.text.startsWith("[") && node.time !== null;
  return isNumber(node) && node.time !== null;
}

export class Panes {
  // label: the title of a pane, from its address.
  constructor(parent, app, label = (address) => address) {
    Object.assign(this, { app, label });
    this.element = el("div", { class: "panes", hidden: true });
    parent.append(this.element);
    this.panes = new Map();
    this.element.addEventListener("dragstart", (event) => this.onStart(event));
    this.element.addEventListener("dragover", (event) => this.onOver(event));
    this.element.addEventListener("dragend", () => this.onEnd());
  }

  // Those of the nodes that have a pane; they stay where they are while they are there.
  choose(nodes) {
    const found = nodes.filter(drawable);
    const kept = found.filter((node) => this.panes.has(node.address));
    return [...kept, ...found.filter((node) => !this.panes.has(node.address))].slice(0, MOST);
  }

  async update(nodes, signal) {
    const wanted = new Set(nodes.map((node) => node.address));
    for (const [address, pane] of this.panes) {
      if (wanted.has(address)) continue;
      pane.element.remove();
      this.panes.delete(address);
    }
    for (const node of nodes) {
      if (this.panes.has(node.address)) continue;
      const pane = new Pane(this, node);
      this.panes.set(node.address, pane);
      this.element.insertBefore(pane.element, this.picturesFirst && isPicture(node) ? this.element.querySelector(".pane:not(.of-picture)") : null);
    }
    this.element.hidden = !nodes.length;
    const results = await Promise.allSettled(nodes.map((node) => this.panes.get(node.address).update(node, signal)));
    results.forEach((result, index) => {
      const { element } = this.panes.get(nodes[index].address) ?? {};
      element?.classList.toggle("gone", result.status === "rejected");
      if (result.status === "rejected" && ![400, 404, 409, 422].includes(result.reason.status)) throw result.reason;
    });
  }

  onStart(event) {
    this.dragged = event.target.closest(".pane");
    this.dragged?.classList.add("dragged");
    event.dataTransfer.effectAllowed = "move";
    event.dataTransfer.setData("text/plain", this.dragged?.address ?? "");
  }

  onOver(event) {
    const over = event.target.closest(".pane");
    if (!this.dragged || !over || over === this.dragged) return;
    event.preventDefault();
    const all = [...this.element.children];
    if (all.indexOf(over) > all.indexOf(this.dragged)) over.after(this.dragged);
    else over.before(this.dragged);
  }

  onEnd() {
    this.dragged?.classList.remove("dragged");
    this.dragged = null;
    this.app.layout.order([...this.element.children].map((it) => it.address));
  }
}
