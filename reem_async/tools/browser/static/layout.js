// What a visitor has arranged: pinned keys, and how plots are drawn. It is kept in this browser.
import { store, stored, toast } from "./util.js";

const MOST = 12; // pinned at a time

export class Layout {
  constructor(title) {
    this.name = `reem:layout:${title}`;
    const before = stored(`reem:pins:${title}`, []); // where pins were kept by themselves
    this.value = { pins: before, plots: {}, ...stored(this.name, {}) };
  }

  save() { store(this.name, this.value); }

  get pins() { return this.value.pins; }

  has(address) { return this.pins.includes(address); }

  toggle(address) {
    const { pins } = this;
    if (!pins.includes(address) && pins.length >= MOST) return toast(`${MOST} are pinned: unpin one first`);
    this.value.pins = pins.includes(address) ? pins.filter((each) => each !== address) : [...pins, address];
    return this.save();
  }

  order(addresses) {
    this.value.pins = [...addresses.filter((each) => this.has(each)), ...this.pins.filter((each) => !addresses.includes(each))];
    this.save();
  }

  // How the plot of an address is drawn: `log`, and the other `keys` in it.
  plot(address) { return Object.hasOwn(this.value.plots, address) ? this.value.plots[address] : {}; }

  setPlot(address, settings) {
    const all = { ...this.plot(address), ...settings };
    if (!all.log) delete all.log;
    if (!all.keys?.length) delete all.keys;
    this.value.plots = { ...this.value.plots, [address]: all };
    if (!Object.keys(all).length) delete this.value.plots[address];
    this.save();
  }
}
