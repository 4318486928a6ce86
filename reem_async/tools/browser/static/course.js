// Numbers over time: one, or the few of a small list or vector.
import { Plot } from "./plot.js";
import { el, getJson } from "./util.js";

export class Course {
  // pause: ms between two looks at a live server.
  constructor(parent, app, address, { pause = 0, small = false } = {}) {
    Object.assign(this, { app, address, pause });
    this.card = el("div", { class: small ? "small-plot" : "card", hidden: true });
    parent.append(this.card);
    this.plot = new Plot(this.card, { time: true, onPick: (at) => { app.time.pause(); app.seek(at); }, label: `Course of ${address} over time; a click shows that instant` });
  }

  async update(signal) {
    const { app } = this, now = performance.now(), live = app.config.live && app.at === null;
    const key = live ? null : `${app.config.live ? Math.floor(app.span.end / 2) : ""}`;
    if (live ? now > (this.asked ?? -Infinity) + this.pause || this.key !== null : key !== this.key) {
      this.asked = now;
      this.data = await getJson("series", { path: this.address }, signal);
      this.key = key;
    }
    this.card.hidden = !this.data.lines.length;
    if (!this.card.hidden) this.plot.set(this.data, app.at);
  }
}
