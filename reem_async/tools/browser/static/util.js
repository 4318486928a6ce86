// Small tools. Text from the server only ever becomes text nodes: nothing here makes HTML of a string.

export function el(tag, props = {}, ...children) {
  const it = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) it.addEventListener(name.slice(2), value);
    else if (name === "class") it.className = value;
    else if (name in it && name !== "list" && !name.includes("-")) it[name] = value;
    else it.setAttribute(name, value === true ? "" : value);
  }
  it.append(...children.filter((child) => child !== null && child !== undefined));
  return it;
}

const NAMES = new Map([["NoneType", "null"], ["str", "text"], ["int", "whole number"], ["float", "number"], ["bool", "true or false"], ["numpy", "array"]]);

// What a kind is called here. What a name from the data is looked up in is a Map: a plain object has a "constructor", too.
export function nameOf(kind) { return NAMES.get(kind) ?? kind; }

const SVG = "http://www.w3.org/2000/svg";

export function icon(path) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("aria-hidden", "true");
  const shape = document.createElementNS(SVG, "path");
  shape.setAttribute("d", path);
  svg.append(shape);
  return svg;
}

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

export function query(values) {
  const search = new URLSearchParams();
  for (const [name, value] of Object.entries(values)) {
    if (value === undefined || value === null || value === "") continue;
    for (const each of Array.isArray(value) ? value : [value]) search.append(name, each);
  }
  return search.toString();
}

async function checked(response) {
  if (response.ok) return response;
  let message = `${response.status} ${response.statusText}`;
  try {
    message = (await response.json()).error || message;
  } catch { /* not from the program itself: the status says it */ }
  throw new ApiError(message, response.status);
}

async function ask(what, values, signal) {
  return fetched(`/api/${what}?${query(values)}`, { signal });
}

export async function fetched(url, options) {
  try {
    return await checked(await fetch(url, options));
  } catch (error) {
    if (error instanceof ApiError || error.name === "AbortError") throw error;
    throw new ApiError("The program behind this page does not answer.", 0);
  }
}

// What an answer holds, as "json", "blob" or "text".
export async function bodyOf(response, form) {
  try {
    return await response[form]();
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ApiError("An answer of the program behind this page broke off.", 0);
  }
}

export async function getJson(what, values, signal) {
  const said = await bodyOf(await ask(what, values, signal), "json");
  if (said.missing !== undefined) throw new ApiError(said.missing, 404);
  return said;
}

export async function getPicture(what, values, signal) {
  const response = await ask(what, values, signal);
  const said = response.headers.get("x-picture");
  return { blob: await bodyOf(response, "blob"), said: said ? JSON.parse(said) : null };
}

export async function postWrite(path, valueText, key, to = "write", retype = false) {
  // The text goes as it is: numbers beyond 2^53 would change in JavaScript.
  const body = `{"path":${JSON.stringify(path)},"value":${valueText},"retype":${retype}}`;
  const headers = { "content-type": "application/json", "x-reem-key": key };
  return fetched(`/api/${to}`, { method: "POST", headers, body });
}

export function setText(it, text) {
  if (it.textContent !== text) it.textContent = text;
}

// Text whose characters all show, as the program's own texts have it.
export function visible(text) {
  return text.replace(/[\u0000-\u001f\u007f-\u009f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g, (it) => `\\u${it.charCodeAt(0).toString(16).padStart(4, "0")}`);
}

export function bytesText(count) {
  if (count === null || count === undefined) return "";
  for (const unit of ["B", "kB", "MB", "GB"]) {
    if (count < 1000 || unit === "GB") return unit === "B" || count >= 100 ? `${Math.round(count)} ${unit}` : `${count.toFixed(1)} ${unit}`;
    count /= 1000;
  }
  return "";
}

export function ageText(seconds) {
  if (seconds < 1) return "now";
  if (seconds < 60) return `${Math.floor(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min`;
  if (seconds < 86400) return `${Math.floor(seconds / 3600)} h`;
  return `${Math.floor(seconds / 86400)} d`;
}

export function clockText(seconds, digits = 3) {
  const when = new Date(seconds * 1000);
  const two = (number) => String(number).padStart(2, "0");
  const fraction = digits ? "." + String(Math.floor((((seconds % 1) + 1) % 1) * 10 ** digits)).padStart(digits, "0") : "";
  return `${two(when.getHours())}:${two(when.getMinutes())}:${two(when.getSeconds())}${fraction}`;
}

export function numberText(value) {
  if (value === null || value === undefined) return "–";
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return String(value);
  const size = Math.abs(value);
  return size >= 1e6 || size < 1e-4 ? value.toExponential(4) : String(Number(value.toPrecision(6)));
}

const DIGITS = 6;

// The numbers in a text with six digits; those before the point are all there, which a time stamp needs.
export function shortNumbers(text) {
  return text.replace(/-?\d+\.\d+(e[-+]?\d+)?/gi, (it) => {
    const value = Number(it), size = Math.abs(value);
    if (it.replace(/^-?0*\.?0*|e.*$|\./gi, "").length <= DIGITS) return it;
    return size >= 1e5 && size < 1e12 ? String(Number(value.toFixed(1))) : numberText(value);
  });
}

// Text with short numbers; all of it is shown when the pointer is on it.
export function setNumbers(it, text) {
  const short = shortNumbers(text);
  setText(it, short);
  it.title = short === text ? "" : text;
}

export function numberEl(tag, text) {
  const it = el(tag);
  setNumbers(it, text);
  return it;
}

// The addresses of what an address is inside of, and itself: "a", "a.b", "a.b[0]" for the last.
export function steps(address) {
  const parts = address.match(/\.?[^.[\]"]+|\[-?\d+\]|\[?"(?:[^"\\]|\\.)*"\]?/g) ?? [address];
  let upto = "";
  return parts.map((part) => ({ part, address: (upto += part).replace(/^\./, "") }));
}

export function addressUrl(address) {
  // A single dot or two as a segment would be taken out of the URL by the browser; addresses have none.
  return address ? "/view/" + encodeURIComponent(address).replaceAll("%5B", "[").replaceAll("%5D", "]") : "/";
}

// A list of keys that a text field offers: those that have the last word in it in their names.
export function suggest(box, app) {
  const names = el("datalist", { id: `keys-${(suggest.count = (suggest.count ?? 0) + 1)}` });
  box.setAttribute("list", names.id);
  box.addEventListener("input", async () => {
    const [before, word] = /^(.*?)(\S*)$/.exec(box.value).slice(1);
    const { found } = await getJson("search", { q: word, at: app.at });
    names.replaceChildren(...found.map(({ address }) => el("option", { value: before + address })));
  });
  return names;
}

export function toast(text) {
  const it = document.getElementById("toast");
  it.textContent = text;
  it.classList.add("shown");
  clearTimeout(toast.timer);
  toast.timer = setTimeout(() => it.classList.remove("shown"), 2500);
}

export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch { // not allowed on plain http from another machine
    const area = el("textarea", { value: text, class: "hidden" });
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  toast("Copied");
}

export function stored(name, otherwise) {
  try {
    return JSON.parse(localStorage.getItem(name)) ?? otherwise;
  } catch {
    return otherwise;
  }
}

export function store(name, value) {
  try {
    localStorage.setItem(name, JSON.stringify(value));
  } catch { /* storage is off or full: nothing is remembered */ }
}

// Put a new picture in the place of an old one once it is decoded: nothing flickers.
export async function swap(image, blob) {
  const url = URL.createObjectURL(blob), next = new Image();
  next.src = url;
  await next.decode().catch(() => {});
  image.src = url;
  await image.decode().catch(() => {});
  next.src = "";
  URL.revokeObjectURL(url);  // the picture stays, also where another one has come meanwhile
}
