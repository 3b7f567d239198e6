"use strict";
// Everything shown comes in as text and goes out as text: no value is ever read as HTML.

const element = (tag, cls, text) => {
  const made = document.createElement(tag);
  if (cls) made.className = cls;
  if (text !== undefined) made.textContent = text;
  return made;
};
const at = (id) => document.getElementById(id);
const path = (...parts) => parts.map((part) => part.split("/").map(encodeURIComponent).join("/")).join("/");

async function ask(method, url, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const answer = await fetch(url, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  if (answer.ok) return answer;
  throw new Error(await reason(answer.status, await answer.text()));
}

function reason(status, text) {
  try {
    const told = JSON.parse(text);
    return told.hint ? `${told.message} (${told.hint})` : told.message;
  } catch {
    return `${status}: ${text.trim()}`;
  }
}

// ---- jobs

const opened = new Map(); // name -> "log" | "files": what the user has unfolded
const shown = new Map(); // name and state -> {text, item}

function age(since) {
  const seconds = Math.max(0, (Date.now() - Date.parse(since)) / 1000);
  for (const [size, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (seconds >= size) return `${Math.round(seconds / size)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

function bars(job) {
  return Object.entries(job.active).map(([label, step]) => {
    const row = element("div", "bar");
    const bar = element("progress");
    bar.setAttribute("aria-label", label);
    if (step.total) Object.assign(bar, { max: step.total, value: step.done });
    const count = step.total ? `${step.done} of ${step.total} ${step.what}` : step.what;
    row.append(element("span", "", label), bar, element("span", "since", count));
    return row;
  });
}

function unfold(item, job, kind) {
  opened.get(job.name) === kind ? opened.delete(job.name) : opened.set(job.name, kind);
  fill(item.querySelector(".more"), job);
}

async function fill(place, job) {
  const kind = opened.get(job.name);
  if (!kind) return place.replaceChildren();
  try {
    const answer = await ask("GET", path("api/jobs", job.name, kind));
    if (kind === "log") {
      const log = element("pre", "", (await answer.text()) || "nothing yet");
      place.replaceChildren(log);
      log.scrollTop = log.scrollHeight;
      return;
    }
    const list = element("ul", "files");
    for (const name of await answer.json()) {
      const link = element("a", "", name);
      link.href = path("results", job.name, name);
      const entry = element("li");
      entry.append(link);
      list.append(entry);
    }
    place.replaceChildren(list);
  } catch (error) {
    place.replaceChildren(element("p", "cause", error.message));
  }
}

function button(text, label, action) {
  const made = element("button", "", text);
  made.type = "button";
  made.setAttribute("aria-label", label);
  made.addEventListener("click", action);
  return made;
}

function actions(item, job) {
  const row = element("div", "actions");
  if (job.report) {
    const link = element("a", "", "Report");
    link.href = path("results", job.name, job.report);
    row.append(link);
  }
  const claimed = !["waiting", "ignored"].includes(job.state);
  if (claimed) {
    row.append(button("Log", `Log of ${job.name}`, () => unfold(item, job, "log")));
    row.append(button("Files", `Files of ${job.name}`, () => unfold(item, job, "files")));
  }
  const post = (what) => async (event) => {
    event.target.disabled = true;
    try {
      await ask("POST", path("api/jobs", job.name, what));
    } catch (error) {
      item.querySelector(".more").replaceChildren(element("p", "cause", error.message));
    }
    event.target.disabled = false;
  };
  if (["failed", "cancelled"].includes(job.state)) row.append(button("Retry", `Retry ${job.name}`, post("retry")));
  if (["waiting", "running", "claimed"].includes(job.state)) {
    row.append(button("Cancel", `Cancel ${job.name}`, post("cancel")));
  }
  return row;
}

function itemOf(job) {
  const item = element("li");
  item.dataset.name = job.name;
  const head = element("div", "head");
  head.append(element("span", "name", job.name), element("span", `state ${job.state}`, job.state));
  if (job.since) {
    const since = element("span", "since");
    since.dataset.since = job.since;
    since.textContent = age(job.since);
    head.append(since);
  }
  item.append(head);
  if (job.cause) item.append(element("p", "cause", job.cause));
  if (job.hint) item.append(element("p", "hint", job.hint));
  item.append(...bars(job));
  for (const note of job.notes) item.append(element("p", "hint", note));
  item.append(actions(item, job), element("div", "more"));
  fill(item.querySelector(".more"), job);
  return item;
}

function show(feed) {
  const list = at("jobs");
  const wanted = new Set();
  let last = null;
  for (const job of feed.jobs) {
    const key = `${job.state === "waiting" || job.state === "ignored" ? "inbox" : "job"}/${job.name}`;
    wanted.add(key);
    const text = JSON.stringify(job);
    let known = shown.get(key);
    if (!known || known.text !== text) {
      const item = itemOf(job);
      const focus = known && known.item.contains(document.activeElement) ? document.activeElement.ariaLabel : null;
      if (known) known.item.replaceWith(item);
      known = { text, item };
      shown.set(key, known);
      if (focus) [...item.querySelectorAll("button")].find((each) => each.ariaLabel === focus)?.focus();
    }
    const place = last ? last.nextSibling : list.firstChild;
    if (place !== known.item) list.insertBefore(known.item, place);
    last = known.item;
  }
  for (const [key, known] of shown) {
    if (!wanted.has(key)) {
      known.item.remove();
      shown.delete(key);
    }
  }
  const count = {};
  for (const job of feed.jobs) count[job.state] = (count[job.state] || 0) + 1;
  const parts = Object.entries(count).map(([state, number]) => `${number} ${state}`);
  at("summary").textContent = parts.join(", ") || "No jobs yet.";
  at("trouble").textContent = feed.trouble && `The watcher is held up: ${feed.trouble}`;
  at("more").textContent = feed.more ? `${feed.more} older jobs are not shown here.` : "";
}

function listen() {
  const source = new EventSource("api/events");
  source.onopen = () => { at("connection").textContent = "live"; };
  source.onerror = () => { at("connection").textContent = "no connection; trying again …"; };
  source.onmessage = (event) => show(JSON.parse(event.data));
}

setInterval(() => {
  for (const since of document.querySelectorAll("[data-since]")) since.textContent = age(since.dataset.since);
}, 5000);

// ---- uploads

function send(url, file, progress) {
  return new Promise((done, failed) => {
    const request = new XMLHttpRequest();
    request.open("PUT", url);
    request.upload.onprogress = (event) => progress(event.loaded);
    request.onload = () => (request.status < 300 ? done() : failed(new Error(reason(request.status, request.responseText))));
    request.onerror = () => failed(new Error("the connection broke; try again"));
    request.send(file);
  });
}

const wantedName = (name) => !name.split("/").some((part) => part.startsWith("."));

async function upload(name, files) {
  const line = element("li", "bar");
  const bar = element("progress");
  const text = element("span", "since", "starting …");
  bar.setAttribute("aria-label", `Sending ${name}`);
  line.append(element("span", "name", name), bar, text);
  at("uploads").append(line);
  let key = null;
  try {
    key = (await (await ask("POST", "api/uploads", { name })).json()).key;
    const total = files.reduce((sum, [, file]) => sum + file.size, 0);
    let before = 0;
    bar.max = total;
    for (const [place, file] of files) {
      await send(path("api/uploads", key, place), file, (sent) => {
        bar.value = before + sent;
        text.textContent = `${place}: ${Math.round((100 * (before + sent)) / total)} %`;
      });
      before += file.size;
    }
    const job = (await (await ask("POST", path("api/uploads", key, "finish"))).json()).name;
    text.textContent = `sent as ${job}`;
    setTimeout(() => line.remove(), 10000);
  } catch (error) {
    text.className = "cause";
    text.textContent = error.message;
    bar.remove();
    if (key) ask("DELETE", path("api/uploads", key)).catch(() => {});
  }
}

function start(name, files) {
  const chosen = at("name").value.trim() || name;
  at("name").value = "";
  const wanted = files.filter(([place]) => wantedName(place));
  if (wanted.length) upload(chosen, wanted);
}

const entriesIn = (reader) => new Promise((done, failed) => reader.readEntries(done, failed));
const fileOf = (entry) => new Promise((done, failed) => entry.file(done, failed));

async function filesBelow(entry, prefix) {
  if (entry.isFile) return [[`${prefix}${entry.name}`, await fileOf(entry)]];
  const found = [];
  const reader = entry.createReader();
  for (let some = await entriesIn(reader); some.length; some = await entriesIn(reader)) {
    for (const each of some) found.push(...(await filesBelow(each, `${prefix}${entry.name}/`)));
  }
  return found;
}

async function dropped(transfer) {
  const items = [...transfer.items].filter((item) => item.kind === "file");
  const loose = items.map((item) => item.getAsFile());
  const entries = items.map((item) => item.webkitGetAsEntry());
  for (const folder of entries.filter((entry) => entry?.isDirectory)) {
    const files = (await filesBelow(folder, "")).map(([place, file]) => [place.split("/").slice(1).join("/"), file]);
    start(folder.name, files);
  }
  const single = loose.filter((file, index) => file && !entries[index]?.isDirectory);
  if (single.length) start(nameByTime(), single.map((file) => [file.name, file]));
}

const nameByTime = () => `capture ${new Date().toISOString().slice(0, 16).replace("T", " ").replace(":", "")}`;

function prepare() {
  const zone = at("drop");
  for (const type of ["dragover", "drop"]) document.addEventListener(type, (event) => event.preventDefault());
  zone.addEventListener("dragover", () => zone.classList.add("over"));
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    zone.classList.remove("over");
    dropped(event.dataTransfer);
  });
  at("folder").addEventListener("change", (event) => {
    const files = [...event.target.files].map((file) => [file.webkitRelativePath.split("/").slice(1).join("/"), file]);
    if (files.length) start(event.target.files[0].webkitRelativePath.split("/")[0], files);
    event.target.value = "";
  });
  at("files").addEventListener("change", (event) => {
    start(nameByTime(), [...event.target.files].map((file) => [file.name, file]));
    event.target.value = "";
  });
}

prepare();
listen();
