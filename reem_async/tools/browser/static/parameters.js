// Parameters: a slider, switch or list for each that a program has declared at or below the chosen path.
import { addressUrl, bodyOf, el, getJson, postWrite, setText, toast } from "./util.js";

const STEPS = 200; // of a slider at least, rounded to a power of ten

export class Parameters {
  constructor(app, address) {
    this.app = app;
    this.address = address;
    this.controls = new Map();
    this.list = el("div", { class: "parameters" });
    this.element = el("section", { class: "card", hidden: true, "aria-labelledby": "parameters-title" }, el("h2", { id: "parameters-title" }, "Parameters"), this.list);
  }

  async update(signal) {
    const settable = this.app.config.live && this.app.at === null; // the past cannot be set
    const { parameters } = settable ? await getJson("parameters", { path: this.address }, signal) : { parameters: [] };
    const known = new Map(parameters.map((each) => [JSON.stringify([each.address, each.type, each.low, each.high, each.choices]), each]));
    for (const key of [...this.controls.keys()]) if (!known.has(key)) this.controls.delete(key);
    for (const [key, each] of known) {
      if (!this.controls.has(key)) this.controls.set(key, new Control(this.app, each));
      this.controls.get(key).update(each);
    }
    const elements = [...known.keys()].map((key) => this.controls.get(key).element);
    if (elements.length !== this.list.children.length || elements.some((each, index) => each !== this.list.children[index])) this.list.replaceChildren(...elements);
    this.element.hidden = !elements.length;
  }
}

class Control {
  constructor(app, parameter) {
    this.app = app;
    this.address = parameter.address;
    this.type = parameter.type;
    this.writing = false; // what was set here is on its way to the program
    this.busy = false; // it is being changed here: what comes from the server must not disturb that
    const id = `parameter-${parameter.address}`, about = `${id}-about`;
    const base = { id, disabled: !app.config.write, "aria-describedby": about };
    this.inputs = this.made(parameter, base);
    for (const input of this.inputs) {
      input.addEventListener("input", () => this.mirror(input));
      input.addEventListener("change", () => this.write(input));
      input.addEventListener("blur", () => { this.busy = this.writing; this.app.refresh(); });
    }
    this.unit = el("span", { class: "unit" });
    this.about = el("p", { class: "hint", id: about });
    this.ignored = el("p", { class: "note", hidden: true });
    this.wrong = el("p", { class: "wrong", role: "alert", hidden: true });
    const name = el("label", { htmlFor: id }, el("a", { href: addressUrl(parameter.address), "data-go": parameter.address }, el("bdi", {}, parameter.shown)));
    this.element = el("div", { class: "parameter" }, name, el("div", { class: "control" }, ...this.inputs, this.unit), this.about, this.ignored, this.wrong);
  }

  made({ type, low, high, choices, shown }, base) {
    if (choices) return [el("select", base, ...choices.map((each) => el("option", { value: each }, each || "(empty)")))];
    if (type === "bool") return [el("input", { ...base, type: "checkbox", role: "switch" })];
    if (type !== "int" && type !== "float") return [el("input", { ...base, type: "text", maxLength: 4000, spellcheck: false, autocomplete: "off" })];
    const step = type === "int" ? 1 : "any";
    const number = el("input", { ...base, type: "number", step, min: low ?? undefined, max: high ?? undefined });
    const span = high - low;
    if (typeof low !== "number" || typeof high !== "number" || !(span > 0) || !Number.isFinite(span)) return [number];
    const stride = type === "int" ? 1 : 10 ** Math.floor(Math.log10(span / STEPS));
    const slider = el("input", { type: "range", min: low, max: high, step: stride, disabled: base.disabled, "aria-label": shown, "aria-describedby": base["aria-describedby"] });
    return [slider, number];
  }

  // The slider and the number beside it show the same.
  mirror(input) {
    this.busy = true;
    this.complain("");
    for (const each of this.inputs) if (each !== input) each.value = input.value;
  }

  async write(input) {
    this.busy = this.writing = true;
    const typed = input.type === "checkbox" ? String(input.checked) : input.value;
    try {
      if (!typed.trim() && this.type !== "str") throw new Error("Type a number, or a list such as [0.5, 1].");
      // Whole numbers go as they were typed: beyond 2^53 they would change in JavaScript.
      const text = this.type === "str" ? JSON.stringify(typed) : this.type === "float" ? String(Number(typed)) : typed.trim();
      try {
        JSON.parse(text);
      } catch {
        throw new Error(`${typed} is not a value; a list is written like [0.5, 1].`);
      }
      await bodyOf(await postWrite(this.address, text, this.app.config.key), "json");
      this.complain("");
      toast("Written");
    } catch (error) {
      this.complain(error.message);
    }
    this.busy = this.writing = false;
    this.app.refresh();
  }

  complain(text) {
    setText(this.wrong, text);
    this.wrong.hidden = !text;
    for (const each of this.inputs) each.setAttribute("aria-invalid", String(Boolean(text)));
  }

  update({ text, unit, range, choices, help, default_text: normal, invalid }) {
    setText(this.unit, unit);
    this.unit.hidden = !unit;
    setText(this.about, [help, choices ? "" : range, `default ${normal}`].filter(Boolean).join(" · "));
    setText(this.ignored, `The stored value is ignored: ${invalid}`);
    this.ignored.hidden = !invalid;
    if (this.busy || !this.wrong.hidden) return;
    for (const each of this.inputs) {
      if (each.type === "checkbox") each.checked = text === "true";
      else if (each.value !== text) each.value = text;
    }
  }
}
