// The first page: what is pinned, then the pictures and plots of the keys that are published most often, and services.
import { MOST, Panes, isNumber } from "./panes.js";
import { el, getJson, setText } from "./util.js";

const BUSY = 6, OF_EACH = 3, BUSY_PAUSE = 5000, SERVICES_PAUSE = 2000, FRESH = 10;
// The keys on the first page, the panes of each, ms until others may take their place, s in which a number must have come.
const LOOKED = 16; // busy keys of which the numbers are looked at
const DAY = 86400, JUDGED = 10, LEAST = 5, VALID = 20000; // s; s of a number and its values that are looked at; ms for which that holds

// Whether a number is about now, in seconds, or thousandths, millionths or milliardths of them since 1970.
function isClock(value, now) { return [1, 1e3, 1e6, 1e9].some((unit) => Math.abs(value / unit - now) < DAY); }

// Whether values only ever count up: whole numbers, or a number that grows with time alone.
export function countsUp(values, times, whole) {
  [values, times] = [values, times].map((all) => all.filter((_, index) => values[index] !== null));
  if (values.some((value, index) => index > 0 && value < values[index - 1])) return false;
  const last = values.length - 1, grown = values[last] - values[0], slope = grown / (times[last] - times[0]);
  return whole || (new Set(values).size >= LEAST && values.every((value, index) => Math.abs(value - values[0] - slope * (times[index] - times[0])) < 0.02 * grown));
}

export class Home {
  constructor(parent, app) {
    this.app = app;
    this.hint = el("div", { class: "empty" }, el("p", {}, "Choose a key to see its value."),
      el("p", {}, el("kbd", {}, "/"), " searches, ", el("kbd", {}, "?"), " shows the keyboard."));
    this.sections = ["Pinned", "Busiest keys"].map((title) => {
      const head = el("h2", { class: "home-title", hidden: true }, title);
      return { head };
    });
    const [pinned, busiest] = this.sections;
    pinned.head.title = "In the order that you drag them to";
    busiest.head.title = "What is published most often, but for time stamps and counters";
    parent.append(app.layouts.element);
    for (const section of this.sections) {
      parent.append(section.head);
      section.panes = new Panes(parent, app);
      section.panes.onPin = () => app.refresh();
    }
    busiest.panes.picturesFirst = true; // pinned ones stay in the order that the visitor gave them
    parent.append(this.hint);
    this.services = new Services(parent, app);
    this.busy = [];
    this.judged = new Map(); // address -> whether it is a clock or a counter, and until when that holds
  }

  async update(signal) {
    this.app.layouts.show();
    const { app } = this, { pins } = app.layout, pinned = await this.pinned(pins, signal);
    const busiest = app.layout.value.busiest === false ? [] : (await this.busiest(signal)).slice(0, Math.max(MOST - pinned.length, 0));
    if (signal?.aborted) return;
    [pinned, busiest].forEach((nodes, index) => { this.sections[index].head.hidden = !nodes.length; });
    this.hint.hidden = pinned.length + busiest.length > 0;
    await this.sections[0].panes.update(pinned, signal);
    await this.sections[1].panes.update(busiest, signal);
    await this.services.update(signal);
    await app.layouts.update(signal);
  }

  async pinned(pins, signal) {
    const results = await Promise.allSettled(pins.map((path) => getJson("node", { path, at: this.app.at }, signal)));
    return results.filter(({ status }) => status === "fulfilled").map(({ value }) => value).filter((node) => node.kind !== "dict");
  }

  async busiest(signal) {
    const { app } = this, now = performance.now(), { panes } = this.sections[1];
    if (!this.busy.length || now > this.chosen + BUSY_PAUSE) {
      const [root] = (await getJson("tree", { at: app.at, open: ["500:0:"] }, signal)).branches;
      this.chosen = now;
      const busy = root.nodes.filter((node) => node.rate >= 0.5).sort((one, other) => other.rate - one.rate).slice(0, LOOKED).map((node) => node.address);
      this.busy = [...this.busy.filter((each) => busy.includes(each)), ...busy.filter((each) => !this.busy.includes(each))];
    }
    if (!this.busy.length) return [];
    const open = ["500:0:", ...this.busy.map((address) => `50:0:${address}`)];
    const { branches: [root, ...branches] } = await getJson("tree", { at: app.at, open }, signal);
    const picked = [];
    for (const [index, address] of this.busy.entries()) {
      const nodes = [...root.nodes.filter((node) => node.address === address), ...branches[index].nodes];
      const fresh = nodes.filter((node) => (node.kind === "numpy" || app.now() - node.time < FRESH) && !app.layout.has(node.address));
      const all = panes.choose(fresh.sort((one, other) => (other.kind === "numpy") - (one.kind === "numpy")));
      const own = [];
      for (const node of all) if (own.length < OF_EACH && !(await this.isDull(node, signal))) own.push(node);
      if (own.length) picked.push(own);
      if (picked.length >= BUSY) break;
    }
    return panes.choose(picked.flat().sort((one, other) => (other.kind === "numpy") - (one.kind === "numpy")));
  }

  // Time stamps and counters always change, and tell nothing as a plot.
  async isDull(node, signal) {
    if (!isNumber(node)) return false;
    if (isClock(Number(node.text), this.app.now())) return true;
    const known = this.judged.get(node.address), now = performance.now();
    if (known && known.until > now) return known.dull;
    const end = this.app.now(), { lines: [values = []], times } = await getJson("series", { path: node.address, start: end - JUDGED, end }, signal);
    const dull = countsUp(values, times, node.kind === "int");
    this.judged.set(node.address, { dull, until: now + (values.length < LEAST ? BUSY_PAUSE : VALID) });
    return dull;
  }
}

// On the first page, a line for each server of each service, as of now.
class Services {
  constructor(parent, app) {
    this.app = app;
    this.next = 0;
    this.lines = el("tbody");
    const heads = ["service", "host", "pid", "calls/s", "median", "errors"].map((text) => el("th", { scope: "col" }, text));
    this.element = el("section", { class: "card services", hidden: true, "aria-label": "Services" }, el("table", {}, el("thead", {}, el("tr", {}, ...heads)), this.lines));
    parent.append(this.element);
  }

  async update(signal) {
    if (!this.app.config.live || performance.now() < this.next) return;
    this.next = performance.now() + SERVICES_PAUSE;
    const { services } = await getJson("services", {}, signal);
    const cells = (it) => [it.service, it.host, it.pid, it.rate?.toFixed(1), it.median === null ? null : `${(it.median * 1000).toFixed(1)} ms`, it.errors];
    this.lines.replaceChildren(...services.map((it) => el("tr", {}, ...cells(it).map((cell) => el("td", {}, `${cell ?? "-"}`)))));
    this.element.hidden = !services.length;
  }
}
