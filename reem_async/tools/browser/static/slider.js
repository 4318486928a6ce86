// Time: the slider, the strip of changes above it, playing, stepping, and the clock.
import { clockText, el, getJson, setText } from "./util.js";

const FRAME = 100; // ms between frames when playing
export const STEP = 0.1; // s

export class TimeBar {
  constructor(app) {
    this.app = app;
    const find = (id) => document.getElementById(id);
    this.bar = document.querySelector(".time");
    [this.slider, this.clock, this.play, this.live, this.speed, this.canvas] = ["slider", "clock", "play", "live", "speed", "activity"].map(find);
    this.dragging = false;
    this.playing = null;
    this.counts = null;
    this.origin = app.span.start;
    this.slider.max = Math.max(app.span.end - app.span.start, 0.001).toFixed(3); // also before the first answer
    if (!app.config.live) {
      this.live.textContent = "End";
      this.live.title = "To the end (l)";
    }
    this.slider.addEventListener("pointerdown", () => { this.dragging = true; this.pause(); });
    for (const name of ["pointerup", "pointercancel", "blur"]) this.slider.addEventListener(name, () => { this.dragging = false; });
    this.slider.addEventListener("input", () => this.onInput());
    this.live.addEventListener("click", () => { this.pause(); app.seek(null); });
    this.play.addEventListener("click", () => this.toggle());
    find("save").hidden = !app.config.live;
    find("back").addEventListener("click", () => this.step(-STEP));
    find("forth").addEventListener("click", () => this.step(STEP));
    new ResizeObserver(() => this.drawActivity()).observe(this.canvas);
    const track = this.canvas.parentElement;
    track.addEventListener("pointermove", (event) => app.axis.point(this.instantAt(event.clientX)));
    track.addEventListener("pointerleave", () => app.axis.point(null));
    app.axis.plots.add(this);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.drawActivity());
  }

  onInput() {
    const value = Number(this.slider.value), most = Number(this.slider.max);
    // The right end is now: dragging there is going back to live.
    this.app.seek(value >= most - 1e-6 ? null : this.origin + value);
  }

  show() {
    const { app } = this, { start, end } = app.span;
    if (!this.dragging) {
      this.origin = start;
      this.slider.max = Math.max(end - start, 0.001).toFixed(3);
      this.slider.value = (app.at === null ? end - start : app.at - start).toFixed(3);
    }
    const past = app.at !== null;
    this.bar.classList.toggle("past", past && app.config.live);
    document.body.classList.toggle("in-past", past || !app.config.live);
    this.bar.classList.toggle("playing", this.playing !== null);
    this.play.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    this.live.setAttribute("aria-pressed", String(!past));
    this.live.disabled = !past && !app.config.live;
    const since = app.sinceText();
    setText(document.getElementById("marked"), since.startsWith("since") ? since : since && `changed ${since}`);
    this.clock.textContent = this.texts().join("\n");
    this.slider.setAttribute("aria-valuetext", this.texts().join(", "));
  }

  texts() {
    const { app } = this, { start, end } = app.span, at = app.at ?? end;
    if (!end) return ["no recording", ""];
    const first = app.config.live && app.at === null ? clockText(at, 0) : clockText(at);
    if (!app.config.live) return [first, `${(at - start).toFixed(2)} of ${(end - start).toFixed(2)} s`];
    return [first, app.at === null ? `${Math.round(end - start)} s kept` : `${(at - end).toFixed(1)} s`];
  }

  toggle() {
    if (this.playing) return this.pause();
    const { app } = this;
    if (app.at === null || app.at >= app.span.end) app.seek(app.span.start);
    this.before = performance.now();
    this.playing = setInterval(() => this.frame(), FRAME);
    this.show();
  }

  pause() {
    clearInterval(this.playing);
    this.playing = null;
    this.show();
  }

  frame() {
    const { app } = this, now = performance.now();
    const passed = ((now - this.before) / 1000) * Number(this.speed.value);
    this.before = now;
    const next = (app.at ?? app.span.end) + passed;
    if (next < app.span.end) return app.seek(next);
    this.pause();
    app.seek(null);
  }

  step(seconds) {
    this.pause();
    const { app } = this, at = (app.at ?? app.span.end) + seconds;
    app.seek(at < app.span.end ? at : null);
  }

  // The instant below a place on the strip, at which all plots show their values.
  instantAt(clientX) {
    const box = this.canvas.getBoundingClientRect(), { start, end } = this.app.span;
    return start + Math.min(Math.max((clientX - box.left) / Math.max(box.width, 1), 0), 1) * (end - start);
  }

  // As a plot has it: drawn when the pointer, or the part that plots show, moves.
  paint() { this.drawActivity(); }

  draw() { this.drawActivity(); }

  async loadActivity() {
    try {
      this.counts = await getJson("activity", { bins: 150, path: this.app.path });
    } catch { /* the strip is an extra: what else fails says so */ }
    this.drawActivity();
  }

  drawActivity() {
    const { canvas, counts } = this, box = canvas.getBoundingClientRect();
    if (!counts || !box.width) return;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    const context = canvas.getContext("2d"), style = getComputedStyle(canvas);
    context.scale(ratio, ratio);
    context.fillStyle = style.getPropertyValue("--accent").trim();
    context.globalAlpha = 0.4;
    const most = Math.max(...counts.counts, 1), { start, end } = this.app.span, span = Math.max(end - start, 0.001);
    const each = (counts.end - counts.start) / counts.counts.length;
    const bar = (index, up, tall) => {
      const left = ((counts.start + index * each - start) / span) * box.width, width = Math.max((each / span) * box.width - 0.5, 1);
      if (left + width > 0) context.fillRect(left, box.height - up - tall, width, tall);
    };
    const foot = counts.pictures.length ? 4 : 0; // below the bars there is a line where pictures are kept
    counts.counts.forEach((count, index) => { if (count) bar(index, foot, 3 + (box.height - foot - 3) * Math.sqrt(count / most)); });
    context.fillStyle = style.getPropertyValue("--mark").trim();
    counts.pictures.forEach((kept, index) => {
      context.globalAlpha = kept === 2 ? 1 : 0.45;
      if (kept) bar(index, 0, 3);
    });
    const { shown, hover } = this.app.axis, at = (instant) => ((instant - start) / span) * box.width;
    context.globalAlpha = 1;
    if (shown) { // the part that plots show
      context.fillStyle = style.getPropertyValue("--accent").trim();
      context.fillRect(at(shown[0]), 0, Math.max(at(shown[1]) - at(shown[0]), 2), 2);
    }
    context.fillStyle = style.getPropertyValue("--soft").trim();
    if (hover !== null) context.fillRect(at(hover), 0, 1, box.height);
    this.explain(Boolean(foot), Boolean(shown), hover);
  }

  // Below the slider, what the bars are; with the pointer on them, what is there.
  explain(pictures, zoomed, hover) {
    const { app, counts } = this, index = hover === null ? -1 : Math.floor(((hover - counts.start) / (counts.end - counts.start)) * counts.counts.length);
    const kept = ["no array kept", "arrays kept as small pictures", "arrays kept whole"][counts.pictures[index]];
    const at = counts.counts[index] === undefined ? "" : `${clockText(hover, 1)}: ${counts.counts[index]} changes${kept ? `, ${kept}` : ""}`;
    const key = `${app.path}|${pictures}|${zoomed}|${at}`;
    if (this.explained === key) return;
    this.explained = key;
    const items = [["change", `changes of ${app.path || "all keys"}`], pictures && ["whole", "arrays kept whole"], pictures && ["small", "as small pictures"], zoomed && ["zoomed", "shown in plots"]];
    document.getElementById("bars").replaceChildren(...(at ? [at] : items.filter(Boolean).map(([kind, text]) => el("span", {}, el("i", { class: kind }), text))));
  }
}
