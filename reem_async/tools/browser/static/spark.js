// A number's course in a row of the tree: what this page has seen of it, as a line of the height of a word.
const MOST = 60; // instants
const WIDTH = 58, HEIGHT = 16;

export class Spark {
  constructor() {
    this.seen = [];
    this.canvas = document.createElement("canvas");
    this.canvas.className = "spark";
    this.canvas.hidden = true;
    this.canvas.setAttribute("aria-hidden", "true");
  }

  show(node, now) {
    const value = node.kind === "int" || node.kind === "float" ? Number(node.text) : NaN;
    if (!Number.isFinite(value)) this.seen = [];
    else this.add(now, value);
    const values = this.seen.map((each) => each.value);
    this.canvas.hidden = values.every((each) => each === values[0]);
    if (!this.canvas.hidden) this.draw(values);
  }

  // Going back in time, what comes after is forgotten.
  add(now, value) {
    while (this.seen.length && this.seen[this.seen.length - 1].now >= now) this.seen.pop();
    this.seen.push({ now, value });
    if (this.seen.length > MOST) this.seen.shift();
  }

  draw(values) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    canvas.width = WIDTH * ratio;
    canvas.height = HEIGHT * ratio;
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.strokeStyle = getComputedStyle(canvas).color;
    context.lineWidth = 1.2;
    context.lineJoin = "round";
    const low = Math.min(...values), high = Math.max(...values), first = this.seen[0].now;
    const span = this.seen[this.seen.length - 1].now - first || 1;
    context.beginPath();
    for (const { now, value } of this.seen) {
      const up = (value / 2 - low / 2) / (high / 2 - low / 2);
      context.lineTo(1 + ((now - first) / span) * (WIDTH - 2), HEIGHT - 2 - up * (HEIGHT - 4));
    }
    context.stroke();
  }
}
