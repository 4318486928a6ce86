// Lines and bars on a canvas: axes, a crosshair with the values under it, and a mark for the instant shown.
import { clockText, el, numberText, setText } from "./util.js";

const LEAST_SPAN = 5e-13; // of the numbers: the least part of them that an axis shows
const NARROW = 40, RIGHT = 12, TOP = 10, BOTTOM = 24;

const MINUTES = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 86400];

function ticks(low, high, most, clock = false) {
  const span = Math.min(high - low || 1, Number.MAX_VALUE);
  const raw = span / Math.max(most, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const steps = clock && raw > 1 ? MINUTES : [1, 2, 5, 10].map((each) => each * power);
  const step = steps.find((each) => each >= raw) ?? span;
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + step * 1e-9 && found.length < 30; at += step) found.push(at);
  return { step, found };
}

// Enough digits to tell one tick from the next.
export function tickText(value, step) {
  if (Math.abs(value) < step * 1e-6) return "0";
  const least = Math.floor(Math.log10(step) + 1e-9), most = Math.floor(Math.log10(Math.abs(value)));
  if (most < 12 && least >= -8) return value.toFixed(Math.max(0, -least));
  return value.toExponential(Math.max(0, Math.min(15, most - least)));
}

export class Plot {
  // options.time: the x axis is an instant; options.onPick: called with the x that was clicked.
  constructor(parent, options = {}) {
    this.options = options;
    this.legend = el("div", { class: "legend" });
    this.canvas = el("canvas", { class: "plot", role: "img" });
    parent.append(this.legend, this.canvas);
    this.data = { names: [], times: [], lines: [] };
    this.hidden = new Set(); // the names of lines that are not drawn
    this.hover = null;
    this.cursor = null;
    this.left = NARROW;
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => { this.hover = null; this.draw(); });
    this.canvas.addEventListener("click", (event) => options.onPick?.(this.xAt(event)));
    if (options.onPick) this.canvas.style.cursor = "crosshair";
  }

  set(data, cursor = null) {
    this.data = data;
    this.cursor = cursor;
    this.draw();
  }

  xAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const part = (event.clientX - box.left - this.left) / Math.max(box.width - this.left - RIGHT, 1);
    return this.x0 + Math.min(Math.max(part, 0), 1) * (this.x1 - this.x0);
  }

  point(event) {
    this.hover = this.xAt(event);
    this.draw();
  }

  range() {
    const { times, lines } = this.data;
    this.x0 = this.data.start ?? times[0] ?? 0;
    this.x1 = this.data.end ?? times[times.length - 1] ?? 1;
    if (this.x1 <= this.x0) this.x1 = this.x0 + 1;
    let low = Infinity, high = -Infinity;
    const shown = lines.filter((_, index) => !this.hidden.has(this.data.names[index]));
    for (const line of shown) for (const value of line) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) [low, high] = [0, 1];
    const size = Math.max(Math.abs(low), Math.abs(high));
    // Floats have 15 to 16 digits: labels of parts of less than that would be the same, and so would the lines be.
    const pad = high === low ? size * 0.05 || 1 : Math.max((high / 2 - low / 2) * 0.12, size * LEAST_SPAN);
    this.y0 = Math.max(low - pad, -Number.MAX_VALUE);
    this.y1 = Math.min(high + pad, Number.MAX_VALUE);
    this.low = low;
    this.high = high;
  }

  draw() {
    const { canvas } = this, box = canvas.getBoundingClientRect();
    if (!box.width) return;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    this.style = getComputedStyle(canvas);
    this.range();
    this.axes(context, box.width, box.height);
    if (this.data.counts) this.bars(context, box.width, box.height);
    else this.curves(context, box.width, box.height);
    this.readout();
    canvas.setAttribute("aria-label", this.options.label ?? `Plot from ${numberText(this.low)} to ${numberText(this.high)}`);
  }

  colour(name) { return this.style.getPropertyValue(name).trim(); }

  place(width, height) {
    const x = (value) => this.left + ((value - this.x0) / (this.x1 - this.x0)) * (width - this.left - RIGHT);
    // Halves: the whole way from -1e308 to 1e308 is infinite.
    const y = (value) => height - BOTTOM - ((value / 2 - this.y0 / 2) / (this.y1 / 2 - this.y0 / 2)) * (height - TOP - BOTTOM);
    return { x, y };
  }

  axes(context, width, height) {
    context.font = `11px ${this.colour("--mono")}`;
    const rows = ticks(this.y0, this.y1, (height - TOP - BOTTOM) / 45);
    const words = rows.found.map((at) => tickText(at, rows.step));
    this.left = Math.max(NARROW, ...words.map((word) => Math.ceil(context.measureText(word).width) + 14));
    const { x, y } = this.place(width, height);
    context.strokeStyle = this.colour("--line");
    context.fillStyle = this.colour("--faint");
    context.lineWidth = 1;
    context.textAlign = "right";
    context.textBaseline = "middle";
    rows.found.forEach((at, index) => {
      context.beginPath();
      context.moveTo(this.left, Math.round(y(at)) + 0.5);
      context.lineTo(width - RIGHT, Math.round(y(at)) + 0.5);
      context.stroke();
      context.fillText(words[index], this.left - 7, y(at));
    });
    context.textBaseline = "top";
    context.textAlign = "center";
    const clock = Boolean(this.options.time), offset = clock ? Math.floor(this.x0 / 3600) * 3600 : 0;
    const columns = ticks(this.x0 - offset, this.x1 - offset, (width - this.left - RIGHT) / 90, clock);
    for (const at of columns.found) {
      const text = clock ? clockText(at + offset + 1e-6, columns.step < 1 ? 1 : 0) : tickText(at, columns.step);
      const where = Math.min(Math.max(x(at + offset), this.left + 14), width - RIGHT - 28);
      context.fillText(text, where, height - BOTTOM + 7);
    }
  }

  curves(context, width, height) {
    const { x, y } = this.place(width, height), { times, lines } = this.data;
    lines.forEach((line, index) => {
      if (this.hidden.has(this.data.names[index])) return;
      context.strokeStyle = this.colour(`--curve-${index % 8}`);
      context.fillStyle = context.strokeStyle;
      context.lineWidth = 1.6;
      context.lineJoin = "round";
      context.beginPath();
      let before = null;
      line.forEach((value, at) => {
        if (value === null) { before = null; return; }
        const across = x(Math.max(times[at], this.x0)), up = y(value);
        if (before === null) context.moveTo(across, up);
        else if (this.options.time) { context.lineTo(across, before); context.lineTo(across, up); }
        else context.lineTo(across, up);
        before = up;
      });
      if (before !== null && this.options.time) context.lineTo(x(this.x1), before); // it still is what it was
      context.stroke();
      if (times.length === 1 && before !== null) { context.beginPath(); context.arc(x(times[0]), before, 3, 0, 7); context.fill(); }
    });
    if (this.cursor !== null) this.upright(context, x(this.cursor), height, "--mark", 2);
    if (this.hover !== null) this.upright(context, x(this.hover), height, "--faint", 1);
  }

  bars(context, width, height) {
    const { x, y } = this.place(width, height), { counts } = this.data;
    const each = (this.x1 - this.x0) / counts.length;
    context.fillStyle = this.colour("--curve-0");
    counts.forEach((count, index) => {
      const left = x(this.x0 + index * each), right = x(this.x0 + (index + 1) * each);
      context.fillRect(left, y(count), Math.max(right - left - (right - left > 4 ? 1 : 0), 0.5), y(0) - y(count));
    });
  }

  upright(context, across, height, colour, thick) {
    context.strokeStyle = this.colour(colour);
    context.lineWidth = thick;
    context.beginPath();
    context.moveTo(across, TOP);
    context.lineTo(across, height - BOTTOM);
    context.stroke();
  }

  // The last index whose x is not after `at`.
  indexAt(at) {
    const { times } = this.data;
    let low = 0, high = times.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= at) low = middle + 1; else high = middle;
    }
    return low - 1;
  }

  readout() {
    const { times, lines, names, counts } = this.data;
    const at = this.hover ?? this.cursor;
    if (counts) {
      const each = (this.x1 - this.x0) / Math.max(counts.length, 1);
      const index = at === null ? -1 : Math.min(Math.floor((at - this.x0) / each), counts.length - 1);
      const from = this.x0 + index * each;
      return this.legend.replaceChildren(index < 0 ? "" : `${numberText(from)} … ${numberText(from + each)}: ${counts[index]}`);
    }
    const index = at === null ? times.length - 1 : this.indexAt(at);
    if (at === null && lines.length === 1) return this.legend.replaceChildren();
    this.entries(names);
    lines.forEach((line, number) => {
      const { text, element } = this.named[number], name = names[number] ? `${names[number]} ` : "";
      setText(text, `${name}${numberText(line[index] ?? null)}`);
      element.title = `${line[index] ?? ""}${lines.length > 1 ? "\nA click hides or shows this line" : ""}`.trim();
      if (lines.length > 1) element.setAttribute("aria-pressed", String(!this.hidden.has(names[number])));
    });
    setText(this.where, index < 0 || at === null ? "" : this.options.time ? clockText(at) : `at ${times[index]}`);
    return undefined;
  }

  // What stands for each line: made once, since a click would miss what is made anew ten times a second.
  entries(names) {
    const key = names.join("|");
    if (this.named?.key === key && this.legend.contains(this.where)) return;
    this.named = names.map((name, number) => {
      const text = el("span");
      if (names.length === 1) return { text, element: text };
      const swatch = el("i");
      swatch.style.background = `var(--curve-${number % 8})`;
      return { text, element: el("button", { type: "button", onclick: () => this.toggle(name) }, swatch, text) };
    });
    this.named.key = key;
    this.where = el("span");
    this.legend.replaceChildren(...this.named.map(({ element }) => element), this.where);
  }

  toggle(name) {
    if (!this.hidden.delete(name)) this.hidden.add(name);
    this.draw();
  }
}

export class Histogram extends Plot {
  range() {
    const { low, high, counts } = this.data;
    [this.x0, this.x1] = [low ?? 0, high ?? 1];
    if (this.x1 <= this.x0) [this.x0, this.x1] = [this.x0 - 0.5, this.x0 + 0.5];
    [this.y0, this.y1] = [0, Math.max(...(counts?.length ? counts : [1])) * 1.06];
    [this.low, this.high] = [this.x0, this.x1];
  }
}
