// What a visitor has arranged: pinned keys, how plots are drawn, and what is drawn over pictures. It is kept in this
// browser; by a name it is kept in the store, where others find it, and an address leads to it.
import { copy, el, getJson, postWrite, setText, store, stored, toast } from "./util.js";

const MOST = 12; // pinned at a time
const NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ -]{0,59}$/u; // of a layout in the store
const PAUSE = 5000; // ms between two looks at the names in the store

const texts = (value, most) => (Array.isArray(value) ? value.filter((each) => typeof each === "string").slice(0, most) : []);
const pairs = (value, make) => Object.fromEntries(Object.entries(value && typeof value === "object" ? value : {}).map(([name, each]) => [name, make(each)]));

// A layout as it should be: what is in the store, or in an address, may be anything.
function checked(value) {
  const plot = (each) => ({ ...(each?.log === true && { log: true }), ...(texts(each?.keys, 7).length && { keys: texts(each.keys, 7) }) });
  return { pins: texts(value?.pins, MOST), plots: pairs(value?.plots, plot), overlays: pairs(value?.overlays, (each) => String(each).slice(0, 500)), busiest: value?.busiest !== false };
}

export class Layout {
  constructor(title) {
    this.place = `reem:layout:${title}`;
    this.before = { pins: stored(`reem:pins:${title}`, []) }; // where pins were kept by themselves
    this.own();
  }

  // Show what is kept in this browser.
  own() {
    this.value = checked(stored(this.place, this.before));
    this.name = null;
  }

  // Show another one: of a name in the store, or "" for that of an address. It is changed on this page only, until it is saved.
  show(value, name) {
    this.value = checked(value);
    this.name = name;
    this.opened = JSON.stringify(this.value);
  }

  get changed() { return this.name !== null && JSON.stringify(this.value) !== this.opened; }

  set(values) {
    Object.assign(this.value, values);
    if (this.name === null) store(this.place, this.value);
  }

  get pins() { return this.value.pins; }

  has(address) { return this.pins.includes(address); }

  toggle(address) {
    const { pins } = this;
    if (!pins.includes(address) && pins.length >= MOST) return toast(`${MOST} are pinned: unpin one first`);
    return this.set({ pins: pins.includes(address) ? pins.filter((each) => each !== address) : [...pins, address] });
  }

  order(addresses) { this.set({ pins: [...addresses.filter((each) => this.has(each)), ...this.pins.filter((each) => !addresses.includes(each))] }); }

  // How the plot of an address is drawn: `log`, and the other `keys` in it.
  plot(address) { return this.of("plots", address) ?? {}; }

  of(what, address) { return Object.hasOwn(this.value[what], address) ? this.value[what][address] : undefined; }

  setPlot(address, settings) { this.put("plots", address, { ...this.plot(address), ...settings }); }

  put(what, address, value) {
    const rest = Object.entries(this.value[what]).filter(([each]) => each !== address), kept = checked({ [what]: { [address]: value } })[what][address];
    this.set({ [what]: Object.fromEntries(kept && Object.keys(kept).length ? [...rest, [address, kept]] : rest) });
  }
}

// The choice of a layout, on the first page.
export class LayoutBar {
  constructor(app) {
    this.app = app;
    this.saved = new Map();
    const button = (text, title, act) => el("button", { type: "button", title, onclick: act }, text);
    this.choice = el("select", { title: "Layouts in the store: pinned keys, plots and what is drawn over pictures", "aria-label": "Layout", onchange: () => this.choose(this.choice.value) });
    this.busiest = el("input", { type: "checkbox", onchange: () => { app.layout.set({ busiest: this.busiest.checked }); app.refresh(); } });
    this.save = button("Save…", app.config.write ? "Save this layout in the store by a name: others can open it" : "Only a page of reem browse --allow-write saves layouts in the store; Link shares one without it", () => this.ask());
    this.save.disabled = !app.config.write;
    this.element = el("div", { class: "layouts" }, el("label", {}, "layout ", this.choice), this.save,
      button("Link", "Copy an address that opens the page with this layout", () => this.link()), el("label", { title: "Show the busiest keys as well as pinned ones" }, this.busiest, "busiest keys"));
  }

  async update(signal) {
    const now = performance.now();
    if (now > (this.next ?? 0)) {
      this.next = now + PAUSE;
      this.saved = new Map(Object.entries((await getJson("layouts", {}, signal)).layouts));
    }
    this.show();
  }

  show() {
    const { layout } = this.app, names = [["own", "own"], ...[...this.saved.keys()].map((name) => [`saved ${name}`, name])];
    if (layout.name === "") names.push(["link", "from the link"]);
    else if (layout.name !== null && !this.saved.has(layout.name)) names.push([`saved ${layout.name}`, layout.name]);
    const chosen = layout.name === null ? "own" : layout.name === "" ? "link" : `saved ${layout.name}`, options = names.map(([value, text]) => [value, text + (value === chosen && layout.changed ? " (changed)" : "")]);
    if (this.shown !== JSON.stringify(options)) this.choice.replaceChildren(...options.map(([value, text]) => el("option", { value }, text)));
    this.shown = JSON.stringify(options);
    this.choice.value = chosen;
    this.busiest.checked = layout.value.busiest;
  }

  choose(value) {
    if (value === "own") this.app.layout.own();
    else if (value.startsWith("saved ")) this.app.layout.show(this.saved.get(value.slice(6)), value.slice(6));
    this.app.go("");
  }

  // What an address names: ?layout= of the store, or #layout= with all of it.
  async open(address) {
    const name = new URLSearchParams(address.search).get("layout"), { layout } = this.app;
    try {
      if (address.hash.startsWith("#layout=")) layout.show(JSON.parse(decodeURIComponent(address.hash.slice(8))), "");
      else if (name !== null && name !== layout.name) {
        const { layouts } = await getJson("layouts", {});
        if (Object.hasOwn(layouts, name)) layout.show(layouts[name], name);
        else toast(`No layout “${name}” is in the store`);
      }
    } catch (error) {
      toast(error.status === undefined ? "The layout in this address is damaged" : error.message);
    }
  }

  // What an address of this page has of the layout.
  get query() { return this.app.layout.name ? `layout=${encodeURIComponent(this.app.layout.name)}` : ""; }

  get hash() { return this.app.layout.name === "" ? location.hash : ""; }

  async link() {
    const { layout } = this.app;
    await copy(`${location.origin}/${layout.name && !layout.changed ? `?${this.query}` : `#layout=${encodeURIComponent(JSON.stringify(layout.value))}`}`);
  }

  ask() {
    const { app } = this, name = el("input", { type: "text", value: app.layout.name ?? "", maxLength: 60, "aria-label": "Name of the layout", placeholder: "name", spellcheck: false });
    const wrong = el("p", { class: "wrong", role: "alert", hidden: true });
    const send = async (value) => {
      try {
        if (!NAME.test(name.value.trim())) throw new Error("Use up to 60 letters, digits, blanks, - and _");
        await postWrite(name.value.trim(), JSON.stringify(value), app.config.key, "layout");
        if (value) app.layout.show(value, name.value.trim());
        else if (app.layout.name === name.value.trim()) app.layout.own();
        form.remove();
        toast(value ? "Saved in the store" : "Removed from the store");
        this.next = 0;
        app.go("");
      } catch (error) {
        setText(wrong, error.message);
        wrong.hidden = false;
      }
    };
    const remove = el("button", { type: "button", onclick: () => send(null), title: "Remove this layout from the store" }, "Remove"), save = el("button", { class: "primary" }, "Save");
    const show = () => {
      const there = this.saved.has(name.value.trim());
      setText(save, there ? "Replace" : "Save");
      remove.hidden = !there;
    };
    const form = el("form", { class: "tools save-layout", onsubmit: (event) => { event.preventDefault(); send(app.layout.value); }, oninput: show }, name, save, remove, el("button", { type: "button", onclick: () => form.remove() }, "Cancel"), wrong);
    this.element.querySelector("form")?.remove();
    this.element.append(form);
    show();
    name.focus();
  }
}
