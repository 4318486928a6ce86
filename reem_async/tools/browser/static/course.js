// Numbers over time: one, the few of a small list or vector, or those of several keys; and the time that all plots show.
import { Plot } from "./plot.js";
import { el, getJson, suggest, toast } from "./util.js";

const MOST_KEYS = 8; // in one plot
const NONE = { names: [""], times: [], lines: [[]] }; // of a key that is not there: it can be taken out of a plot
const SETTLED = 150; // ms without another step of zooming until the part that is shown is read

// What all plots over time have in common: the part of it that they show, and the instant under the pointer.
export class TimeAxis {
  constructor(app) {
    Object.assign(this, { app, window: null, hover: null, plots: new Set() });
  }

  get full() { return [this.app.span.start, Math.max(this.app.span.end, this.app.span.start + 1e-3)]; }

  // The part that is shown, null for all. One that ended at the newest instant goes on with it.
  get shown() {
    if (!this.window || !this.follows) return this.window;
    const [start, end] = this.window, now = this.app.span.end;
    return [now - (end - start), now];
  }

  // What is read to show it: more on both sides, in steps, so that a little panning reads nothing.
  get read() {
    if (!this.shown) return [null, null];
    const [start, end] = this.shown, step = 2 ** Math.ceil(Math.log2(end - start)) / 2;
    return [Math.max((Math.floor(start / step) - 1) * step, this.full[0]), (Math.ceil(end / step) + 1) * step];
  }

  zoom(window) {
    this.window = window;
    this.follows = Boolean(window) && this.app.config.live && window[1] > this.full[1] - 0.02 * (window[1] - window[0]);
    this.each("draw");
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.app.refresh(), SETTLED);
  }

  // The mark of the slider in all plots, before anything is read for that instant.
  seek(at) {
    for (const plot of this.plots) plot.cursor = at;
    this.each("paint");
  }

  point(at) {
    this.hover = at;
    this.each("paint");
  }

  // All plots are drawn in the next frame, however often the pointer moves before it: wholly, or what follows the pointer.
  each(how) {
    if (this.due !== "draw") this.due = how;
    this.frame ??= requestAnimationFrame(() => {
      const { due } = this;
      this.frame = this.due = null;
      for (const plot of this.plots) if (plot.canvas.isConnected) plot[due](); else this.plots.delete(plot);
    });
  }
}

export class Course {
  // pause: ms between two looks at a live server.
  constructor(parent, app, address, { pause = 0, small = false } = {}) {
    Object.assign(this, { app, address, pause });
    this.card = el("div", { class: small ? "small-plot" : "card", hidden: true });
    parent.append(this.card);
    const { log } = app.layout.plot(address);
    this.plot = new Plot(this.card, {
      axis: app.axis, small, log, label: `Course of ${address} over time; a click shows that instant`,
      onPick: (at) => { app.time.pause(); app.seek(at); }, onLog: (on) => app.layout.setPlot(address, { log: on }), onRemove: (key) => this.keep(this.others.filter((each) => each !== key)),
    });
    this.plot.tools.append(el("button", { type: "button", title: "Draw another key in this plot (or drag its row onto it)", "aria-label": "Draw another key in this plot", onclick: () => this.ask() }, "+ key"));
    this.card.addEventListener("dragover", (event) => { if (event.dataTransfer.types.includes(ROW)) event.preventDefault(); });
    this.card.addEventListener("drop", (event) => this.add(event.dataTransfer.getData(ROW)));
  }

  get others() { return this.app.layout.plot(this.address).keys ?? []; }

  ask() {
    const box = el("input", { type: "text", placeholder: "another key", title: "Enter adds it, Esc closes", "aria-label": "Key to draw in this plot", spellcheck: false, autocomplete: "off" });
    const form = el("form", { class: "add-key", onsubmit: (event) => { event.preventDefault(); box.blur(); this.add(box.value.trim()); } }, box, suggest(box, this.app));
    box.addEventListener("keydown", (event) => { if (event.key === "Escape") box.blur(); });
    box.addEventListener("blur", () => form.remove());
    this.plot.tools.before(form);
    box.focus();
  }

  async add(key) {
    if (!key || key === this.address || this.others.includes(key)) return undefined;
    if (this.others.length + 1 >= MOST_KEYS) return toast(`${MOST_KEYS} keys are in this plot: take one out first`);
    const { lines, message } = await getJson("series", { path: key }).catch((error) => error);
    return lines?.length ? this.keep([...this.others, key]) : toast(message ?? `No numbers at ${key}`);
  }

  keep(keys) {
    this.app.layout.setPlot(this.address, { keys });
    this.app.refresh();
  }

  async update(signal) {
    const { app, others } = this, now = performance.now(), live = app.config.live && app.at === null, [start, end] = app.axis.read;
    const fixed = live ? "" : app.config.live ? Math.floor(app.span.end / 2) : "log", key = JSON.stringify([others, start, app.axis.follows && end, fixed]);
    if (key !== this.wanted || (live && now > this.asked + this.pause)) {
      this.asked = now;
      this.wanted = key;
      const reading = this.read(key, signal).catch((error) => { this.wanted = null; throw error; });
      if (app.config.live) await reading;
      else reading.then(() => this.draw(), (error) => app.failed(error)); // it may take seconds, in which the page shows other instants
    }
    this.draw();
  }

  async read(key, signal) {
    const { app, others } = this, [start, end] = app.axis.read;
    const get = (path) => getJson("series", { path, start, end: app.axis.follows ? null : end }, signal);
    const ask = (path) => app.config.live ? get(path) : inTurn(() => get(path));
    const [first, ...more] = await Promise.all([ask(this.address), ...others.map((path) => ask(path).catch((error) => { if (!error.status) throw error; return NONE; }))]);
    if (key !== this.wanted) return;
    this.data = others.length ? [first, ...more].map((each, index) => ({ ...(each.lines.length || !index ? each : NONE), key: index ? others[index - 1] : this.address })) : first;
  }

  draw() {
    if (!this.data) return;
    this.card.hidden = ![this.data].flat().some((each) => each.lines.length);
    if (!this.card.hidden) this.plot.set(this.data, this.app.at);
  }
}

// Two at a time: a browser has six connections for all that a page asks, and the slider needs some.
const turns = [Promise.resolve(), Promise.resolve()];
let turn = 0;

function inTurn(work) {
  const lane = turn++ % turns.length, result = turns[lane].then(work);
  turns[lane] = result.catch(() => {});
  return result;
}

export const ROW = "application/x-reem-key"; // the type of a row of the tree that is dragged
