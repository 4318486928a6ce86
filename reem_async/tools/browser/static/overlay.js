// Boxes and points of other keys over a picture, by a hint that is kept in the layout.
import { el, getJson, setText, suggest } from "./util.js";

const TITLE = "Boxes or points of other keys, in pixels of this picture:\ndet.boxes\nboxes xywh det.found\npoints relative face.corners\nFour numbers are left, top, right, bottom (xyxy), unless xywh or cxcywh says otherwise. Several are separated by ;";

// The field in which the hint is typed.
export function overlayField(app, address) {
  const box = el("input", { type: "text", class: "overlay-hint", value: app.layout.of("overlays", address) ?? "", placeholder: "key of boxes or points", title: TITLE, "aria-label": "Overlay: key of boxes or points", spellcheck: false, autocomplete: "off", maxLength: 500,
    onchange: () => { app.layout.put("overlays", address, box.value.trim()); app.refresh(); } });
  return el("label", { title: TITLE }, "overlay ", box, suggest(box, app));
}

export class Overlay {
  constructor(image, app, address) {
    Object.assign(this, { image, app, address });
    this.canvas = el("canvas", { class: "overlay", "aria-hidden": "true" });
    this.wrong = el("p", { class: "wrong", role: "alert", hidden: true });
    new ResizeObserver(() => this.draw()).observe(image);
  }

  // size: the columns and rows of the array that is shown.
  async update(size, signal) {
    const hint = this.app.layout.of("overlays", this.address);
    this.size = size;
    this.said = hint ? await getJson("overlay", { hint, at: this.app.at }, signal) : { shapes: [], wrong: "" };
    setText(this.wrong, this.said.wrong);
    this.wrong.hidden = !this.said.wrong;
    this.draw();
  }

  draw() {
    const { canvas, image } = this, wide = image.clientWidth, tall = image.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!this.said || !wide) return;
    if (!this.said.shapes.length) return canvas.remove();
    if (!canvas.isConnected) image.after(canvas);
    Object.assign(canvas.style, { left: `${image.offsetLeft}px`, top: `${image.offsetTop}px`, width: `${wide}px`, height: `${tall}px` });
    [canvas.width, canvas.height] = [wide * ratio, tall * ratio];
    const context = canvas.getContext("2d"), style = getComputedStyle(canvas), [columns, rows] = this.size, fit = Math.min(wide / columns, tall / rows);
    context.scale(ratio, ratio);
    context.translate((wide - columns * fit) / 2, (tall - rows * fit) / 2); // as the picture is in its box
    Object.assign(context, { font: `11px ${style.getPropertyValue("--mono")}`, textBaseline: "bottom", lineWidth: 2 });
    for (const [numbers, label, part, relative] of this.said.shapes) {
      const colour = style.getPropertyValue(`--over-${part % 4}`).trim(), [left, top, right, bottom] = numbers.map((each, index) => each * fit * (relative ? [columns, rows][index % 2] : 1));
      Object.assign(context, { strokeStyle: colour, fillStyle: colour });
      if (numbers.length === 4) context.strokeRect(left, top, right - left, bottom - top);
      else context.fill(new Path2D(`M${left - 4} ${top}a4 4 0 1 0 8 0a4 4 0 1 0 -8 0`));
      if (!label) continue;
      const width = context.measureText(label).width + 6, up = Math.max(numbers.length === 4 ? top : top - 6, 14);
      context.fillRect(left, up - 14, width, 14);
      context.fillStyle = "#000";
      context.fillText(label, left + 3, up - 1);
    }
  }
}
