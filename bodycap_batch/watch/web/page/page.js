"use strict";
// All values are inserted as text, never as HTML.

const element = (tag, cls, text) => {
  const node = document.createElement(tag);
  if (cls) node.className = cls;
  if (text !== undefined) node.textContent = text;
  return node;
};
const byId = (id) => document.getElementById(id);
const path = (...parts) => parts.map((part) => part.split("/").map(encodeURIComponent).join("/")).join("/");

async function request(method, url, body) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const response = await fetch(url, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  if (response.ok) return response;
  throw new Error(errorText(response.status, await response.text()));
}

function errorText(status, text) {
  try {
    const error = JSON.parse(text);
    return error.hint ? `${error.message} (${error.hint})` : error.message;
  } catch {
    return `${status}: ${text.trim()}`;
  }
}

// ---- jobs

const opened = new Map(); // name -> "log" | "files": the part that the user has opened
const shown = new Map(); // "inbox/name" or "job/name" -> {text, item}

const age = (since) => duration(Math.max(0, (Date.now() - Date.parse(since)) / 1000));

function duration(seconds) {
  for (const [size, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (seconds >= size) return `${Math.round(seconds / size)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

function progressBars(job) {
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

function toggle(item, job, kind) {
  opened.get(job.name) === kind ? opened.delete(job.name) : opened.set(job.name, kind);
  showDetails(item.querySelector(".more"), job);
}

async function showDetails(target, job) {
  const kind = opened.get(job.name);
  if (!kind) return target.replaceChildren();
  try {
    const response = await request("GET", path("api/jobs", job.name, kind));
    if (kind === "log") {
      const log = element("pre", "", (await response.text()) || "no entries yet");
      target.replaceChildren(log);
      log.scrollTop = log.scrollHeight;
      return;
    }
    const list = element("ul", "files");
    for (const name of await response.json()) {
      const link = element("a", "", name);
      link.href = path("results", job.name, name);
      const entry = element("li");
      entry.append(link);
      list.append(entry);
    }
    target.replaceChildren(list);
  } catch (error) {
    target.replaceChildren(element("p", "cause", error.message));
  }
}

function button(text, label, action) {
  const node = element("button", "", text);
  node.type = "button";
  node.setAttribute("aria-label", label);
  node.addEventListener("click", action);
  return node;
}

function actionRow(item, job) {
  const row = element("div", "actions");
  if (job.report) {
    const link = element("a", "", "Report");
    link.href = path("results", job.name, job.report);
    row.append(link);
  }
  const claimed = !["waiting", "ignored"].includes(job.state);
  if (claimed) {
    row.append(button("Log", `Log of ${job.name}`, () => toggle(item, job, "log")));
    row.append(button("Files", `Files of ${job.name}`, () => toggle(item, job, "files")));
  }
  const post = (what) => async (event) => {
    event.target.disabled = true;
    try {
      await request("POST", path("api/jobs", job.name, what));
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

// A job that has ended shows the verdict about its results: a computed result can still be a poor one.
const gradeClass = { good: "good", "usable with care": "fair", poor: "poor", "no result": "poor" };

function stateBadge(job) {
  if (!job.verdict) return element("span", `state ${job.state}`, job.state);
  return element("span", `state ${gradeClass[job.verdict] || job.state}`, `${job.state}: ${job.verdict}`);
}

function listItem(job) {
  const item = element("li");
  item.dataset.name = job.name;
  const head = element("div", "head");
  head.append(element("span", "name", job.name), stateBadge(job));
  if (job.duration_s !== null && job.duration_s !== undefined) {
    head.append(element("span", "since", `took ${duration(job.duration_s)}`));
  } else if (job.since && !["done", "failed", "cancelled"].includes(job.state)) {
    const since = element("span", "since");
    since.dataset.since = job.since;
    since.textContent = `for ${age(job.since)}`;
    head.append(since);
  }
  item.append(head);
  if (job.headline) item.append(element("p", "headline", job.headline));
  if (job.cause) item.append(element("p", "cause", job.cause));
  if (job.hint && !job.asks) item.append(element("p", "hint", job.hint));
  item.append(...progressBars(job));
  for (const note of job.notes) item.append(element("p", "hint", note));
  if (job.asks) item.append(askAgain(job));
  item.append(actionRow(item, job), element("div", "more"));
  showDetails(item.querySelector(".more"), job);
  return item;
}

function showJobs(data) {
  const list = byId("jobs");
  const keys = new Set();
  let last = null;
  for (const job of data.jobs) {
    const key = `${job.state === "waiting" || job.state === "ignored" ? "inbox" : "job"}/${job.name}`;
    keys.add(key);
    const text = JSON.stringify(job);
    let entry = shown.get(key);
    if (!entry || entry.text !== text) {
      const item = listItem(job);
      const focus = entry && entry.item.contains(document.activeElement) ? document.activeElement.ariaLabel : null;
      if (entry) entry.item.replaceWith(item);
      entry = { text, item };
      shown.set(key, entry);
      if (focus) [...item.querySelectorAll("button")].find((node) => node.ariaLabel === focus)?.focus();
    }
    const position = last ? last.nextSibling : list.firstChild;
    if (position !== entry.item) list.insertBefore(entry.item, position);
    last = entry.item;
  }
  for (const [key, entry] of shown) {
    if (!keys.has(key)) {
      entry.item.remove();
      shown.delete(key);
    }
  }
  const count = {};
  for (const job of data.jobs) count[job.state] = (count[job.state] || 0) + 1;
  const parts = Object.entries(count).map(([state, number]) => `${number} ${state}`);
  byId("summary").textContent = parts.join(", ") || "No jobs yet.";
  byId("trouble").textContent = data.trouble && `The watcher cannot continue: ${data.trouble}`;
  byId("more").textContent = data.more ? `${data.more} older jobs are not shown here.` : "";
}

function listen() {
  const source = new EventSource("api/events");
  source.onopen = () => { byId("connection").textContent = "live"; };
  source.onerror = () => { byId("connection").textContent = "no connection; trying again …"; };
  source.onmessage = (event) => showJobs(JSON.parse(event.data));
}

setInterval(() => {
  for (const since of document.querySelectorAll("[data-since]")) since.textContent = `for ${age(since.dataset.since)}`;
}, 5000);

// ---- questions: the height of the person, and the places of cameras whose names do not contain them

// Shows the questions, and calls `start` with the answers. `sourceOf` gives the address of a video.
function questionForm(asks, sourceOf, startText, start) {
  const form = element("form", "ask");
  const heightLabel = element("label", "", "Height of the person ");
  const height = element("input");
  Object.assign(height, { type: "text", name: "height", placeholder: "1.75, 175 or 5'9\"", size: 14, value: asks.height ?? "" });
  heightLabel.append(height, element("span", "since", " without it, sizes can be wrong by a tenth"));
  form.append(heightLabel);
  if (asks.unknown.length) form.append(element("p", "", "Where on the body was each of these cameras?"));
  const selects = asks.unknown.map((recording) => {
    const row = element("label", "place");
    const film = element("video");
    Object.assign(film, { src: `${sourceOf(recording.files[0])}#t=1`, muted: true, preload: "metadata" });
    film.addEventListener("error", () => film.replaceWith(element("span", "film since", "no preview")));
    const select = element("select");
    select.required = true;
    select.name = recording.name;
    select.append(new Option("choose the place", ""));
    for (const place of asks.places) select.append(new Option(place.replaceAll("_", " "), place));
    row.append(film, element("span", "", recording.files.join(", ")), select);
    form.append(row);
    return select;
  });
  const find = element("input");
  find.type = "checkbox";
  if (asks.found_places.length) {
    const label = element("label", "find");
    const names = asks.found_places.map((place) => place.replaceAll("_", " "));
    label.append(find, ` I do not know which is which. The cameras were on ${names.slice(0, -1).join(", ")} and ${names.at(-1)}: find out from the motion.`);
    find.addEventListener("change", () => {
      for (const select of selects) select.disabled = find.checked;
    });
    form.append(label);
  }
  const error = element("p", "cause");
  const submit = element("button", "", startText);
  submit.type = "submit";
  form.append(submit, error);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    submit.disabled = true;
    error.textContent = "";
    const places = find.checked ? {} : Object.fromEntries(selects.map((select) => [select.name, select.value]));
    try {
      await start({ height: height.value, places, find_places: find.checked });
    } catch (failure) {
      error.textContent = failure.message;
    }
    submit.disabled = false;
  });
  return form;
}

function askAgain(job) {
  const sourceOf = (file) => path("inputs", job.name, file);
  return questionForm(job.asks, sourceOf, "Start again", (answers) =>
    request("POST", path("api/jobs", job.name, "retry"), answers));
}

// ---- uploads

function send(url, file, progress) {
  return new Promise((resolve, reject) => {
    const upload = new XMLHttpRequest();
    upload.open("PUT", url);
    upload.upload.onprogress = (event) => progress(event.loaded);
    upload.onload = () => (upload.status < 300 ? resolve() : reject(new Error(errorText(upload.status, upload.responseText))));
    upload.onerror = () => reject(new Error("the connection failed; try again"));
    upload.send(file);
  });
}

const isVisible = (name) => !name.split("/").some((part) => part.startsWith("."));

async function uploadFiles(name, files, answers) {
  const line = element("li", "bar");
  const bar = element("progress");
  const text = element("span", "since", "starting …");
  bar.setAttribute("aria-label", `Sending ${name}`);
  line.append(element("span", "name", name), bar, text);
  byId("uploads").append(line);
  let key = null;
  try {
    key = (await (await request("POST", "api/uploads", { name })).json()).key;
    const total = files.reduce((sum, [, file]) => sum + file.size, 0);
    let sentBefore = 0;
    bar.max = total;
    for (const [filePath, file] of files) {
      await send(path("api/uploads", key, filePath), file, (sent) => {
        bar.value = sentBefore + sent;
        text.textContent = `${filePath}: ${Math.round((100 * (sentBefore + sent)) / total)} %`;
      });
      sentBefore += file.size;
    }
    const job = (await (await request("POST", path("api/uploads", key, "finish"), answers)).json()).name;
    text.textContent = `sent as ${job}`;
    setTimeout(() => line.remove(), 10000);
  } catch (error) {
    text.className = "cause";
    text.textContent = error.message;
    bar.remove();
    if (key) request("DELETE", path("api/uploads", key)).catch(() => {});
  }
}

function startUpload(name, files) {
  const chosen = byId("name").value.trim() || name;
  byId("name").value = "";
  const visible = files.filter(([filePath]) => isVisible(filePath));
  if (visible.length) askAndUpload(chosen, visible);
}

async function askAndUpload(name, files) {
  const line = element("li", "new");
  line.append(element("span", "name", name));
  byId("uploads").append(line);
  try {
    const asks = await (await request("POST", "api/questions", { names: files.map(([filePath]) => filePath) })).json();
    const sent = files.filter(([filePath]) => !asks.ignored.includes(filePath));
    if (asks.ignored.length) {
      line.append(element("p", "hint", `not sent, because a job does not use them: ${asks.ignored.join(", ")}`));
    }
    if (!sent.length) return;
    if (asks.has_job) {
      line.remove();
      uploadFiles(name, sent, {});
      return;
    }
    const fileOf = new Map(sent);
    const form = questionForm(asks, (filePath) => URL.createObjectURL(fileOf.get(filePath)), "Start", async (answers) => {
      await request("POST", "api/answers", answers);
      line.remove();
      uploadFiles(name, sent, answers);
    });
    const discard = button("Discard", `Discard ${name}`, () => line.remove());
    form.querySelector("button").after(discard);
    line.append(form);
  } catch (error) {
    line.append(element("p", "cause", error.message));
  }
}

const entriesIn = (reader) => new Promise((resolve, reject) => reader.readEntries(resolve, reject));
const fileOf = (entry) => new Promise((resolve, reject) => entry.file(resolve, reject));

async function filesBelow(entry, prefix) {
  if (entry.isFile) return [[`${prefix}${entry.name}`, await fileOf(entry)]];
  const found = [];
  const reader = entry.createReader();
  for (let batch = await entriesIn(reader); batch.length; batch = await entriesIn(reader)) {
    for (const child of batch) found.push(...(await filesBelow(child, `${prefix}${entry.name}/`)));
  }
  return found;
}

async function uploadDropped(transfer) {
  const items = [...transfer.items].filter((item) => item.kind === "file");
  const itemFiles = items.map((item) => item.getAsFile());
  const entries = items.map((item) => item.webkitGetAsEntry());
  for (const folder of entries.filter((entry) => entry?.isDirectory)) {
    const files = (await filesBelow(folder, "")).map(([filePath, file]) => [filePath.split("/").slice(1).join("/"), file]);
    startUpload(folder.name, files);
  }
  const single = itemFiles.filter((file, index) => file && !entries[index]?.isDirectory);
  if (single.length) startUpload(nameByTime(), single.map((file) => [file.name, file]));
}

const nameByTime = () => `capture ${new Date().toISOString().slice(0, 16).replace("T", " ").replace(":", "")}`;

function prepare() {
  const zone = byId("drop");
  for (const type of ["dragover", "drop"]) document.addEventListener(type, (event) => event.preventDefault());
  zone.addEventListener("dragover", () => zone.classList.add("over"));
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    zone.classList.remove("over");
    uploadDropped(event.dataTransfer);
  });
  byId("folder").addEventListener("change", (event) => {
    const files = [...event.target.files].map((file) => [file.webkitRelativePath.split("/").slice(1).join("/"), file]);
    if (files.length) startUpload(event.target.files[0].webkitRelativePath.split("/")[0], files);
    event.target.value = "";
  });
  byId("files").addEventListener("change", (event) => {
    startUpload(nameByTime(), [...event.target.files].map((file) => [file.name, file]));
    event.target.value = "";
  });
}

prepare();
listen();
