// Zooming and panning a plot: wheel, dragging, two fingers, keys, and the buttons above it.
import { el } from "./util.js";

const MOVED = 5; // px after which a press is a drag, and no click
const STEP = 1.6; // by which a press of a button zooms
const DOUBLE = 250; // ms in which a second click makes a double one, which shows all again
const KEYS = "+ and − zoom, < and > move, 0 shows all";

export class Gestures {
  constructor(plot) {
    const { canvas, options } = plot;
    Object.assign(this, { plot, pointers: new Map(), drag: null });
    canvas.addEventListener("pointermove", (event) => this.onMove(event));
    canvas.addEventListener("pointerleave", () => { if (!this.drag) plot.point(null); });
    canvas.addEventListener("pointerdown", (event) => this.onDown(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.onUp(event, name === "pointerup"));
    canvas.style.cursor = options.onPick ? "crosshair" : "";
    canvas.addEventListener("wheel", (event) => this.onWheel(event), { passive: false });
    canvas.addEventListener("dblclick", () => { clearTimeout(this.picking); this.reset(); });
    canvas.addEventListener("keydown", (event) => this.onKey(event));
    canvas.setAttribute("aria-keyshortcuts", "+ - < > 0");
    const button = (text, title, act) => el("button", { type: "button", title, "aria-label": title, onclick: act }, text);
    this.all = button("All", `Show all of it again (double click on the plot; keys: ${KEYS})`, () => this.reset());
    this.log = button("log", "Logarithmic axis", () => { plot.log = !plot.log; options.onLog?.(plot.log); plot.draw(); });
    plot.tools.append(this.all, button("−", "Zoom out (wheel, or two fingers)", () => this.scale(STEP)),
      button("+", "Zoom in (wheel, two fingers, or drag over a part; drag with Shift moves)", () => this.scale(1 / STEP)), this.log);
  }

  show() {
    this.all.hidden = !(this.plot.axis ? this.plot.axis.window : this.plot.window);
    this.log.setAttribute("aria-pressed", String(this.plot.log));
  }

  reset() { this.plot.zoom(...this.plot.full()); }

  // Show `factor` times as much, with the place at `about` staying where it is.
  scale(factor, about = (this.plot.x0 + this.plot.x1) / 2) {
    const { x0, x1 } = this.plot;
    this.plot.zoom(about - (about - x0) * factor, about + (x1 - about) * factor);
  }

  pan(part) {
    const { x0, x1 } = this.plot, by = part * (x1 - x0);
    this.plot.zoom(x0 + by, x1 + by);
  }

  onWheel(event) {
    const { plot } = this, chosen = event.ctrlKey || event.metaKey || document.activeElement === plot.canvas;
    if (plot.options.small && !chosen) return; // a page of many plots is scrolled
    event.preventDefault();
    const step = (value) => value * (event.deltaMode === 1 ? 16 : 1);
    if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.pan(step(event.shiftKey ? event.deltaY || event.deltaX : event.deltaX) / 600);
    else this.scale(Math.exp(Math.min(Math.max(step(event.deltaY) * (event.ctrlKey ? 4 : 1), -240), 240) / 400), plot.xAt(event.clientX));
  }

  onDown(event) {
    const { plot } = this, { canvas } = plot, box = canvas.getBoundingClientRect();
    this.pointers.set(event.pointerId, event.clientX);
    const touch = event.pointerType === "touch", axis = event.clientY > box.bottom - plot.bottom;
    const pans = touch || axis || event.shiftKey || event.button === 1;
    if (event.button === 1) event.preventDefault();
    this.drag = { x: event.clientX, at: plot.xAt(event.clientX), window: [plot.x0, plot.x1], width: box.width - plot.left, moved: false, pans, fingers: [...this.pointers.values()] };
  }

  onMove(event) {
    const { plot, drag } = this;
    if (!drag || !this.pointers.has(event.pointerId)) return plot.point(plot.xAt(event.clientX));
    this.pointers.set(event.pointerId, event.clientX);
    const [x0, x1] = drag.window, perPixel = (x1 - x0) / drag.width, now = [...this.pointers.values()];
    if (now.length === 2 && drag.fingers.length === 2) {
      drag.moved = true;
      const spread = ([one, other]) => Math.max(Math.abs(one - other), 20), middle = ([one, other]) => (one + other) / 2;
      const factor = spread(drag.fingers) / spread(now), about = x0 + (middle(drag.fingers) - plot.canvas.getBoundingClientRect().left - plot.left) * perPixel;
      const by = (middle(now) - middle(drag.fingers)) * perPixel * factor;
      return plot.zoom(about - (about - x0) * factor - by, about + (x1 - about) * factor - by);
    }
    if (!drag.moved && Math.abs(event.clientX - drag.x) < MOVED) return undefined;
    if (!drag.moved) plot.canvas.setPointerCapture(event.pointerId);
    drag.moved = true;
    const by = (event.clientX - drag.x) * perPixel;
    if (drag.pans) return plot.zoom(x0 - by, x1 - by);
    plot.selection = [drag.at, plot.xAt(event.clientX)];
    return plot.point(plot.selection[1]);
  }

  onUp(event, ended) {
    const { plot, drag } = this, { selection } = plot;
    this.pointers.delete(event.pointerId);
    if (this.pointers.size) { this.drag = { ...drag, fingers: [], x: [...this.pointers.values()][0], window: [plot.x0, plot.x1], moved: true }; return; }
    this.drag = plot.selection = null;
    if (!ended || !drag) return plot.paint();
    if (!drag.moved && event.button === 0) {
      clearTimeout(this.picking);
      this.picking = setTimeout(() => plot.options.onPick?.(drag.at), this.all.hidden === false ? DOUBLE : 0);
      return plot.paint();
    }
    if (selection) plot.zoom(Math.min(...selection), Math.max(...selection));
  }

  onKey(event) {
    const acts = { "+": () => this.scale(1 / STEP), "=": () => this.scale(1 / STEP), "-": () => this.scale(STEP), "<": () => this.pan(-0.25), ">": () => this.pan(0.25), 0: () => this.reset() };
    if (event.ctrlKey || event.metaKey || event.altKey || !Object.hasOwn(acts, event.key)) return;
    acts[event.key]();
    event.preventDefault();
    event.stopPropagation();
  }
}
