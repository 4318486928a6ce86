// The page: which path and which instant are shown, what keeps them up to date, and the keyboard.
import { TimeAxis } from "./course.js";
import { Layout, LayoutBar } from "./layout.js";
import { STEP, TimeBar } from "./slider.js";
import { makeSplitter } from "./splitter.js";
import { Tree } from "./tree.js";
import { View } from "./view.js";
import { addressUrl, clockText, el, getJson, setText } from "./util.js";

const config = JSON.parse(document.body.dataset.config);
const REST = 4; // times as long as a refresh took there is no other one: a robot's programs may share these processors
const SILENCE = 5000; // ms without an event after which the connection counts as lost

const app = {
  config,
  at: null, // null: now, or the end of a recording
  previous: null, // the instant shown before
  path: "",
  layout: new Layout(config.title),
  span: { start: config.start, end: config.end },
  heard: performance.now(),
  done: 0,
  took: 0,

  now() { return this.at ?? this.span.end; },

  // From when on changes are marked.
  since() {
    if (this.at !== null) return this.previous ?? this.at;
    return config.live ? this.span.end - 1 : (this.previous ?? this.span.end);
  },

  sinceText() {
    if (this.at === null && config.live) return "within 1 s";
    return this.previous === null ? "" : `since ${clockText(this.since())}`;
  },

  spanFrom(said) {
    const begins = !this.span.end && said.end; // the recording is open now
    this.span = { start: said.start, end: said.end };
    reading.hidden = said.part === 1;
    reading.value = said.part;
    lost("server", said.lost);
    document.getElementById("source").title = said.note || config.title;
    time.show();
    if (begins && !config.live) { time.loadActivity(); this.refresh(); }
    if (config.live && this.at !== null && this.at < said.start - 0.5) this.seek(said.start); // it has left the buffer
  },

  seek(at) {
    if (!this.span.end) return; // nothing is known yet
    if (at !== null) at = Math.min(Math.max(at, this.span.start), this.span.end);
    this.previous = this.at ?? this.span.end; // from when on changes are marked
    this.at = at;
    time.show();
    this.axis.seek(at);
    this.refresh();
    clearTimeout(this.remembering);
    this.remembering = setTimeout(() => history.replaceState(null, "", this.url()), 300);
  },

  url() {
    const query = [this.layouts.query, this.at === null ? "" : `at=${this.at.toFixed(3)}`].filter(Boolean).join("&");
    return addressUrl(this.path) + (query && `?${query}`) + this.layouts.hash;
  },

  go(address, push = true) {
    this.path = address;
    if (push) history.pushState(null, "", this.url());
    document.body.classList.toggle("has-view", address !== "");
    document.body.classList.remove("searching");
    document.title = `${address || config.title} · REEM`;
    view.show(address);
    if (address) tree.reveal(address);
    time.loadActivity();
    this.refresh();
  },

  // One refresh at a time; what was asked for meanwhile is one more after it.
  async refresh(valueToo = true) {
    this.valueToo ||= valueToo;
    if (this.busy) { this.again = true; return; }
    this.busy = true;
    try {
      do {
        this.again = false;
        const began = performance.now(), value = this.valueToo;
        this.valueToo = false;
        const results = await Promise.allSettled([finder.shown ? finder.refresh() : tree.refresh(), value ? view.refresh() : null]);
        this.done = performance.now();
        this.took = this.done - began;
        if (value) [this.valueDone, this.valueTook] = [this.done, this.took];
        for (const result of results) if (result.status === "rejected") this.failed(result.reason);
      } while (this.again);
    } finally {
      this.busy = false; // whatever went wrong: a page that is busy for ever shows nothing new
    }
  },

  // Something changed, or may have: a page that takes long to make is made less often.
  news(paths, many) {
    const now = performance.now();
    this.owed ||= many || view.concerns(paths);
    if (this.busy || now < this.done + REST * this.took) return; // the next event comes within a second
    const due = now > (this.valueDone ?? 0) + Math.max(1000, 10 * (this.valueTook ?? 0));
    this.refresh(this.owed || due);
    this.owed = false;
  },

  failed(error) {
    if (error.name === "AbortError") return;
    if (error.status === 503) lost("server", error.message);
    else if (error.status === 0) lost("page", error.message);
    else if (error.status === undefined) throw error;
  },
};

const reading = document.getElementById("reading");
const troubles = new Map();

// What is said in plain words of what is wrong; the details are shown when the pointer is on it.
const TROUBLES = {
  page: (since) => `“reem browse”, the program behind this page, has not answered since ${since}. What is shown is from then. Once it runs again, so does this page.`,
  old: () => "This page is of an earlier start of “reem browse”. Open the address that it prints now.",
  server: (since) => `The server at ${config.title} has not answered since ${since}. What is shown is from then. It is asked again and again.`,
};

// Say what is wrong in the banner, or that it is over, and whether what is shown is live.
function lost(what, details) {
  if (!details) troubles.delete(what);
  else troubles.set(what, { details, since: troubles.get(what)?.since ?? clockText(Date.now() / 1000, 0) });
  const [worst] = ["old", "page", "server"].filter((each) => troubles.has(each)), trouble = troubles.get(worst);
  const banner = document.getElementById("banner");
  setText(banner, trouble ? TROUBLES[worst](trouble.since) : "");
  banner.title = trouble?.details ?? "";
  banner.hidden = !trouble;
  document.body.classList.toggle("lost", Boolean(trouble));
  document.getElementById("dot").className = `dot ${trouble ? "lost" : "ok"}`;
}

// The search box, whose results take the place of the tree.
class Finder {
  constructor() {
    this.box = document.getElementById("search");
    this.element = document.getElementById("tree");
    this.box.addEventListener("input", () => { clearTimeout(this.timer); this.timer = setTimeout(() => this.changed(), 120); });
    this.box.addEventListener("keydown", (event) => this.onKey(event));
  }

  get shown() { return this.box.value.trim() !== ""; }

  changed() {
    this.element.replaceChildren();
    document.body.classList.toggle("searching", this.shown);
    this.element.classList.toggle("found", this.shown);
    tree.rows.clear();
    app.refresh();
  }

  async refresh() {
    const text = this.box.value.trim();
    const answer = await getJson("search", { q: text, at: app.at });
    if (text !== this.box.value.trim()) return;
    tree.branches = new Map([["", { address: "", total: answer.found.length, start: 0, nodes: answer.found.map((node) => ({ ...node, label: node.shown, count: null, text: node.text || (node.count === null ? "" : `${node.count} ${node.count === 1 ? "item" : "items"}`) })) }]]);
    if (answer.found.length) {
      tree.render();
      if (answer.found.length >= answer.most) this.element.append(el("p", { class: "hint empty" }, `The first ${answer.most}; more letters find less.`));
      return;
    }
    this.element.replaceChildren(el("p", { class: "empty" }, `No key has “${text}” in its name.`));
  }

  onKey(event) {
    const first = this.element.querySelector(".row");
    if (event.key === "Escape") this.clear();
    else if (event.key === "Enter" && first) app.go(first.address);
    else if (event.key === "ArrowDown" && first) tree.focus(first);
    else return;
    event.preventDefault();
  }

  clear() {
    this.box.value = "";
    this.changed();
    this.box.blur();
  }
}

let events = null;

// A hidden page lets go of its connection: a browser has six for all pages of one host.
function listen() {
  events?.close();
  clearTimeout(listen.again);
  if (document.hidden) return;
  events = new EventSource("/api/events");
  events.onopen = () => { app.heard = performance.now(); lost("page", ""); app.refresh(); };
  events.onmessage = (event) => {
    app.heard = performance.now();
    lost("page", "");
    const said = JSON.parse(event.data);
    app.spanFrom(said);
    if (config.live && app.at === null) app.news(said.paths, said.more);
    if (config.live && performance.now() - (app.counted ?? 0) > 1000) { app.counted = performance.now(); time.loadActivity(); }
  };
  events.onerror = () => {
    lost("page", "The stream of events ended.");
    if (events.readyState === EventSource.CLOSED) refused().then(() => { listen.again = setTimeout(listen, 2000); });
  };
}

// Why there are no events: each start of the program has a token of its own.
async function refused() {
  try {
    await getJson("activity", {});
  } catch (error) {
    if (error.status === 403) lost("old", error.message);
  }
}

setInterval(() => {
  if (!troubles.has("page") && performance.now() - app.heard > SILENCE && !document.hidden) lost("page", `No event for ${SILENCE / 1000} s.`);
}, 1000);

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch { // a stray %: the program says that there is no such path
    return text;
  }
}

async function route() {
  const address = location.pathname.startsWith("/view/") ? decoded(location.pathname.slice(6)) : "";
  const at = Number(new URLSearchParams(location.search).get("at"));
  app.at = !at ? null : app.span.end ? Math.min(Math.max(at, app.span.start), app.span.end) : at;
  await app.layouts.open(location);
  app.go(address, false);
}

function onKey(event) {
  const typing = event.target.matches?.("input[type=text], input[type=search], textarea, select, .control input");
  if (event.ctrlKey || event.metaKey || event.altKey || typing || document.querySelector("dialog[open]")) return;
  const pressed = event.target.closest?.("button, summary, a");
  if (event.key === "/") { finder.box.focus(); finder.box.select(); }
  else if (event.key === "Escape" && finder.shown) finder.clear();
  else if (event.key === "?") document.getElementById("help").showModal();
  else if (event.key === "ArrowLeft") time.step(event.shiftKey ? -1 : -STEP);
  else if (event.key === "ArrowRight") time.step(event.shiftKey ? 1 : STEP);
  else if (event.key === " " && !pressed) time.toggle();
  else if (event.key === "l" || event.key === "End") { time.pause(); app.seek(null); }
  else if (event.key === "Home") { time.pause(); app.seek(app.span.start); }
  else return;
  event.preventDefault();
}

app.axis = new TimeAxis(app);
app.layouts = new LayoutBar(app);
const time = new TimeBar(app);
const tree = new Tree(document.getElementById("tree"), app, "", `reem:open:${config.title}`);
const view = new View(document.getElementById("view"), app);
const finder = new Finder();
app.time = time;

document.getElementById("badge").hidden = !config.write;
makeSplitter(document.querySelector("main"), document.getElementById("edge"));
document.getElementById("to-keys").addEventListener("click", () => document.getElementById("tree-panel").scrollIntoView({ behavior: "smooth" }));
document.getElementById("help-button").addEventListener("click", () => document.getElementById("help").showModal());
document.addEventListener("click", (event) => {
  const link = event.target.closest("a[data-go]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  app.go(link.dataset.go);
});
document.addEventListener("keydown", onKey);
document.addEventListener("visibilitychange", () => { app.heard = performance.now(); listen(); });
window.addEventListener("popstate", route);
route().finally(listen);
