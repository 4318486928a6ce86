// Lines and filled steps on a canvas: axes, gaps, a cursor with the values under it, and a mark for the instant shown.
import { Gestures } from "./gestures.js";
import { clockText, el, numberText, setText } from "./util.js";

const LEAST_SPAN = 5e-13; // of the numbers: the least part of them that an axis shows
const NARROW = 40;
const RIGHT = 12, TOP = 10, BOTTOM = 24; // px around the curves
const CLOSE = 5; // px from a mark within which the pointer is on it
const SILENCE = 0.5; // s of no update that are marked, beside a loss

const MINUTES = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 86400];

function ticks(low, high, most, clock = false) {
  const span = Math.min(high - low || 1, Number.MAX_VALUE), raw = span / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
  const steps = clock && raw > 1 ? MINUTES : [1, 2, 5, 10].map((each) => each * power);
  const step = steps.find((each) => each >= raw) ?? span, found = [];
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

// The places of ticks, with their texts: on a log axis powers of ten, if there are some, else numbers as on any axis.
function rowsOf(low, high, most, log) {
  if (log && high - low >= 1) {
    const stride = Math.ceil((high - low) / Math.max(most, 1)), first = Math.ceil(low / stride);
    return Array.from({ length: Math.floor(high / stride) - first + 1 }, (_, index) => (first + index) * stride).map((at) => ({ at, text: Math.abs(at) > 5 ? `1e${at}` : tickText(10 ** at, 10 ** at) }));
  }
  const { step, found } = log ? ticks(10 ** low, 10 ** high, most) : ticks(low, high, most);
  return found.filter((at) => !log || at > 0).map((at) => ({ at: log ? Math.log10(at) : at, text: tickText(at, step) }));
}

function line(context, colour, thick, ...ends) {
  Object.assign(context, { strokeStyle: colour, lineWidth: thick });
  context.beginPath();
  for (const [across, up] of ends) context.lineTo(across, up);
  context.stroke();
}

// Do something that draws in these spans of the x axis only.
function within(context, spans, height, act) {
  const room = new Path2D();
  for (const [from, to] of spans) room.rect(from, 0, to - from, height);
  context.save();
  context.clip(room);
  act();
  context.restore();
}

// Spans without the holes in them.
function without(spans, holes) {
  for (const [from, to] of holes) {
    spans = spans.flatMap(([left, right]) => (to <= left || from >= right ? [[left, right]] : [[left, from], [to, right]].filter(([one, other]) => other > one)));
  }
  return spans;
}

// The last index whose x is not after `at`.
function indexAt(times, at) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= at) low = middle + 1; else high = middle;
  }
  return low - 1;
}

// One listener for all: a listener of each plot would outlive the view that shows it.
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.querySelectorAll("canvas").forEach((canvas) => canvas.plot?.draw()));

export class Plot {
  // options: axis, the TimeAxis of all plots over time; onPick, called with the x that was clicked; small, it is in a
  // pane; bars, each value holds until the next x, filled; log, the axis is logarithmic at first; onLog, called when that changes; onRemove, called with a key to take out.
  constructor(parent, options = {}) {
    this.options = options;
    this.axis = options.axis ?? null;
    this.legend = el("div", { class: "legend" });
    this.tools = el("div", { class: "plot-tools" });
    this.canvas = el("canvas", { class: "plot", role: "img", tabIndex: 0 });
    this.note = el("p", { class: "plot-note", hidden: true });
    parent.append(el("div", { class: "plot-head" }, this.legend, this.tools), this.canvas, this.note);
    this.sets = [];
    this.curves = []; // all lines of all sets
    this.hidden = new Set(); // the names of lines that are not drawn
    this.log = Boolean(options.log);
    this.window = null; // the part of the x axis that is shown, where there is no axis that others share
    this.pointed = null; // the x under the pointer
    this.cursor = null;
    this.selection = null; // what is being dragged over, to zoom in on it
    [this.left, this.bottom] = [NARROW, BOTTOM]; // px, of which the axes take
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.canvas.plot = this;
    this.gestures = new Gestures(this);
  }

  // data: names, times and lines, with the start and end of the x axis, the spans in which updates were lost (`losses`)
  // or none came (`quiet`); or several of these, each with its `key`.
  set(data, cursor = null) {
    this.sets = Array.isArray(data) ? data : [data];
    this.curves = this.sets.flatMap((set) => set.lines.map((values, index) => ({ set, values, times: set.times, name: [set.key, set.names[index]].filter(Boolean).join(" ") })));
    this.data = this.sets[0];
    for (const set of this.sets) set.quiet = without(set.quiet ?? [], set.losses ?? []).filter(([from, to]) => to - from > SILENCE);
    this.cursor = cursor;
    this.axis?.plots.add(this);
    this.draw();
  }

  get hover() { return this.axis ? this.axis.hover : this.pointed; }
  get times() { return Boolean(this.axis); }
  get steps() { return this.times || Boolean(this.options.bars); }

  xAt(clientX) {
    const box = this.canvas.getBoundingClientRect();
    const part = (clientX - box.left - this.left) / Math.max(box.width - this.left - RIGHT, 1);
    return this.x0 + Math.min(Math.max(part, 0), 1) * (this.x1 - this.x0);
  }

  point(at) {
    if (this.axis) return this.axis.point(at);
    this.pointed = at;
    return this.paint();
  }

  // The whole x axis, of which a part may be shown.
  full() {
    if (this.axis) return this.axis.full;
    const start = this.data?.start ?? this.data?.times[0] ?? 0, end = this.data?.end ?? this.data?.times[this.data.times.length - 1] ?? 1;
    return [start, end > start ? end : start + 1];
  }

  zoom(start, end) {
    const [first, last] = this.full(), least = this.axis ? 1e-3 : (last - first) / 1e6;
    const width = Math.max(end - start, least), from = Math.min(Math.max(start, first), Math.max(last - width, first));
    const window = width >= (last - first) * 0.999 ? null : [from, from + width];
    if (this.axis) return this.axis.zoom(window);
    this.window = window;
    return this.draw();
  }

  range() {
    const [first, last] = this.full();
    [this.x0, this.x1] = (this.axis ? this.axis.shown : this.window) ?? [this.data?.start ?? first, this.data?.end ?? last];
    if (this.x1 <= this.x0) this.x1 = this.x0 + 1;
    let low = Infinity, high = -Infinity;
    this.below = 0; // numbers that have no place on a log axis
    for (const { values, times, name } of this.curves) {
      if (this.hidden.has(name)) continue;
      const to = indexAt(times, this.x1);
      for (let index = Math.max(indexAt(times, this.x0), 0); index <= to; index += 1) {
        const value = values[index];
        if (value === null) continue;
        if (this.log && value <= 0) this.below += 1;
        else [low, high] = [Math.min(low, value), Math.max(high, value)];
      }
    }
    if (low > high) [low, high] = this.log ? [1, 10] : [0, 1];
    if (this.options.bars && !this.log) low = 0;
    [this.low, this.high] = [low, high];
    if (this.log) [low, high] = [Math.log10(low), Math.log10(high)];
    const size = Math.max(Math.abs(low), Math.abs(high));
    // Floats have 15 to 16 digits: labels of parts of less than that would be the same, and so would the lines be.
    const pad = high === low ? (this.log ? 0.3 : size * 0.05 || 1) : Math.max((high / 2 - low / 2) * 0.12, size * LEAST_SPAN);
    this.y0 = this.options.bars && !this.log ? 0 : Math.max(low - pad, -Number.MAX_VALUE);
    this.y1 = Math.min(high + pad, Number.MAX_VALUE);
  }

  draw() {
    const { canvas } = this, box = canvas.getBoundingClientRect();
    if (!box.width) return;
    const ratio = window.devicePixelRatio || 1;
    this.base ??= document.createElement("canvas"); // all but what follows the pointer
    for (const each of [this.base, canvas]) [each.width, each.height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    const context = this.base.getContext("2d");
    context.scale(ratio, ratio);
    [this.width, this.height, this.ratio] = [box.width, box.height, ratio];
    this.style = getComputedStyle(canvas);
    this.range();
    this.axes(context, box.width, box.height);
    within(context, [[this.left - 1, box.width - RIGHT + 1]], box.height - BOTTOM + 1, () => this.drawCurves(context, box.width, box.height));
    this.explain();
    this.gestures.show();
    this.paint();
    canvas.setAttribute("aria-label", this.options.label ?? `Plot from ${numberText(this.low)} to ${numberText(this.high)}`);
  }

  // What follows the pointer, over all else.
  paint() {
    if (!this.base) return;
    const { canvas, width, height } = this, context = canvas.getContext("2d"), { x } = this.place(width, height);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.drawImage(this.base, 0, 0);
    context.scale(this.ratio, this.ratio);
    if (this.selection) {
      const [from, to] = this.selection.map(x);
      Object.assign(context, { fillStyle: this.colour("--accent"), globalAlpha: 0.18 });
      context.fillRect(Math.min(from, to), TOP, Math.abs(to - from), height - TOP - BOTTOM);
      context.globalAlpha = 1;
    }
    for (const [at, colour, thick] of [[this.cursor, "--mark", 2], [this.hover, "--faint", 1]]) {
      if (at === null || at < this.x0 || at > this.x1) continue;
      line(context, this.colour(colour), thick, [x(at), TOP], [x(at), height - BOTTOM]);
      if (at === this.hover) this.label(context, x(at), this.where(at));
    }
    this.readout();
  }

  // What is at the cursor, beside it: it takes no room of the legend, which would move the plot below the pointer.
  label(context, across, text) {
    Object.assign(context, { font: `11px ${this.colour("--mono")}`, fillStyle: this.colour("--panel"), globalAlpha: 0.85, textAlign: "left", textBaseline: "middle" });
    const wide = context.measureText(text).width + 8, left = across + 4 + wide > this.width ? across - 4 - wide : across + 4;
    context.fillRect(left, TOP, wide, 16);
    Object.assign(context, { fillStyle: this.colour("--soft"), globalAlpha: 1 });
    context.fillText(text, left + 4, TOP + 8);
  }

  colour(name) { return this.style.getPropertyValue(name).trim(); }

  place(width, height) {
    const x = (value) => this.left + ((value - this.x0) / (this.x1 - this.x0)) * (width - this.left - RIGHT);
    // Halves: the whole way from -1e308 to 1e308 is infinite.
    const up = (value) => height - BOTTOM - ((value / 2 - this.y0 / 2) / (this.y1 / 2 - this.y0 / 2)) * (height - TOP - BOTTOM);
    return { x, up, y: this.log ? (value) => up(Math.log10(value)) : up };
  }

  axes(context, width, height) {
    context.font = `11px ${this.colour("--mono")}`;
    const rows = rowsOf(this.y0, this.y1, (height - TOP - BOTTOM) / 38, this.log);
    this.left = Math.max(NARROW, ...rows.map(({ text }) => Math.ceil(context.measureText(text).width) + 14));
    const { x, up } = this.place(width, height);
    Object.assign(context, { fillStyle: this.colour("--faint"), textAlign: "right", textBaseline: "middle" });
    for (const { at, text } of rows) {
      line(context, this.colour("--line"), 1, [this.left, Math.round(up(at)) + 0.5], [width - RIGHT, Math.round(up(at)) + 0.5]);
      context.fillText(text, this.left - 7, up(at));
    }
    Object.assign(context, { textBaseline: "top", textAlign: "center" });
    const offset = this.times ? Math.floor(this.x0 / 3600) * 3600 : 0;
    const columns = ticks(this.x0 - offset, this.x1 - offset, (width - this.left - RIGHT) / 90, this.times);
    for (const at of columns.found) {
      const digits = Math.min(Math.max(-Math.floor(Math.log10(columns.step) + 1e-9), 0), 4);
      const text = this.times ? clockText(at + offset + 1e-6, digits) : tickText(at, columns.step);
      const where = Math.min(Math.max(x(at + offset), this.left + 14), width - RIGHT - 28);
      context.fillText(text, where, height - BOTTOM + 7);
    }
  }

  drawCurves(context, width, height) {
    const { x, y } = this.place(width, height), area = [this.left, width - RIGHT];
    const spans = (list) => (list ?? []).map(([from, to]) => [x(from), x(to)]).filter(([from, to]) => to > area[0] && from < area[1]);
    this.curves.forEach(({ values, times, name, set }, index) => {
      if (this.hidden.has(name)) return;
      const holes = spans(set.losses).filter(([from, to]) => to - from >= 1), quiet = without(spans(set.quiet), holes);
      const path = new Path2D(), last = indexAt(times, this.x1) + (this.steps ? 0 : 1);
      let before = null;
      for (let at = Math.max(indexAt(times, this.x0), 0); at <= last && at < times.length; at += 1) {
        const value = values[at];
        if (value === null || (this.log && value <= 0)) {
          if (before !== null && this.steps) path.lineTo(x(times[at]), before);
          before = null;
          continue;
        }
        const across = x(this.steps ? Math.max(times[at], this.x0) : times[at]), up = y(value);
        if (before === null) path.moveTo(across, up);
        else if (this.steps) path.lineTo(across, before);
        path.lineTo(across, up);
        before = up;
      }
      const end = x(Math.min(this.x1, set.end ?? this.x1));
      if (before !== null && this.steps) path.lineTo(end, before); // it still is what it was
      const colour = this.colour(`--curve-${index % 8}`);
      Object.assign(context, { strokeStyle: colour, fillStyle: colour, lineWidth: 1.6, lineJoin: "round" });
      if (this.options.bars && before !== null) {
        const below = new Path2D(path);
        for (const edge of [end, x(Math.max(times[0], this.x0))]) below.lineTo(edge, height - BOTTOM);
        context.globalAlpha = 0.4;
        context.fill(below);
        context.globalAlpha = 1;
      }
      within(context, without([[0, width]], [...holes, ...quiet]), height, () => context.stroke(path));
      within(context, quiet, height, () => { context.setLineDash([2, 4]); context.stroke(path); });
      if (times.length === 1 && before !== null) context.fillRect(x(times[0]) - 2, before - 2, 5, 5);
    });
    for (const { losses } of this.sets) this.drawLosses(context, spans(losses), height);
  }

  // Where updates were lost: a tinted span, and a triangle at its end, which is seen however short it is.
  drawLosses(context, spans, height) {
    context.fillStyle = this.colour("--bad");
    for (const [from, to] of spans) {
      context.globalAlpha = 0.12;
      context.fillRect(from, TOP, Math.max(to - from, 1), height - TOP - BOTTOM);
      context.globalAlpha = 1;
      context.fill(new Path2D(`M${to - 4} 1h8L${to} ${TOP}z`));
    }
  }

  // Below the plot, what the marks in it are, as long as there are any.
  explain() {
    const seen = (name) => this.sets.some((set) => (set[name] ?? []).some(([from, to]) => to > this.x0 && from < this.x1));
    const words = [seen("losses") && "▼ updates were lost", seen("quiet") && "┄ no update came: the last value", this.below > 0 && `${this.below} numbers of 0 and less have no place on a log axis`];
    setText(this.note, words.filter(Boolean).join(" · "));
    this.note.hidden = !this.note.textContent;
    this.note.classList.toggle("lossy", seen("losses"));
  }

  readout() {
    const at = this.hover ?? this.cursor, { curves } = this;
    if (!curves.length || (at === null && curves.length === 1)) return this.legend.replaceChildren();
    this.entries(curves.map(({ name }) => name).join("|"));
    curves.forEach(({ values, times, name, set }, number) => {
      const lost = at !== null && (set.losses ?? []).some(([from, to]) => at > from && at < to); // what it was is not known
      const { text, element } = this.named[number], value = lost ? null : values[at === null ? times.length - 1 : indexAt(times, at)] ?? null;
      setText(text, `${name}${name && " "}${numberText(value)}`);
      element.title = `${value ?? ""}${curves.length > 1 ? "\nA click hides or shows this line" : ""}`.trim();
      if (curves.length > 1) element.setAttribute("aria-pressed", String(!this.hidden.has(name)));
    });
    return undefined;
  }

  // The place of the cursor, and what a mark there means.
  where(at) {
    const from = this.data?.times[indexAt(this.data.times, at)], to = this.data?.times[indexAt(this.data.times, at) + 1] ?? this.data?.end;
    if (!this.times) return from === undefined ? "" : this.options.bars ? `${numberText(from)} … ${numberText(to)}` : `at ${numberText(from)}`;
    const hit = (name, more) => this.sets.flatMap((set) => set[name] ?? []).find(([start, end]) => at >= start - more && at <= end + more);
    const loss = hit("losses", (CLOSE / Math.max(this.width - this.left, 1)) * (this.x1 - this.x0));
    const said = loss ? `${loss[2] ?? ""} ${loss[2] === 1 ? "update" : "updates"} lost` : hit("quiet", 0) ? "no update came" : "";
    return [clockText(at), said.trim()].filter(Boolean).join(" ");
  }

  // What stands for each line: made once, since a click would miss what is made ten times a second.
  entries(key) {
    if (this.named?.key === key && this.legend.contains(this.named[0].element)) return;
    this.named = this.curves.map(({ name, set }, number) => {
      const text = el("span");
      if (this.curves.length === 1) return { text, element: text };
      const swatch = el("i");
      swatch.style.background = `var(--curve-${number % 8})`;
      const element = el("button", { type: "button", onclick: () => { if (!this.hidden.delete(name)) this.hidden.add(name); this.draw(); } }, swatch, text);
      const last = set.key && set !== this.data && this.curves[number + 1]?.set !== set;
      const remove = last ? el("button", { type: "button", class: "remove", title: `Take ${set.key} out of this plot`, "aria-label": `Take ${set.key} out of this plot`, onclick: () => this.options.onRemove?.(set.key) }, "×") : null;
      return { text, element, remove };
    });
    this.named.key = key;
    this.legend.replaceChildren(...this.named.map(({ element, remove }) => (remove ? el("span", { class: "entry" }, element, remove) : element)));
  }
}
