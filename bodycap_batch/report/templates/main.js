const raw = JSON.parse(document.getElementById("data").textContent);
const section = document.querySelector("section.viewer");

function webgl() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
  return Boolean(gl);
}

// Parse the library, which is stored as text, only if WebGL is available: parsing takes longer than all the rest.
// The library adds style sheets for formulas and menus. This page does not use them, so they are discarded.
function loadThree() {
  let made = null;
  const discarded = document.createElement("div");
  const isolated = new Proxy(document, {
    get(real, key) {
      if (key === "head") return discarded;
      if (key === "querySelector") return () => discarded;
      return typeof real[key] === "function" ? real[key].bind(real) : real[key];
    },
  });
  window.bodycapLibrary = { isolated, define: (_name, _needs, make) => (made = make()) };
  const script = document.createElement("script");
  const text = document.getElementById("library").textContent;
  script.textContent = `((document, define) => {${text}\n})(bodycapLibrary.isolated, bodycapLibrary.define);`;
  document.head.append(script);
  delete window.bodycapLibrary;
  return made.ThreeJsProvider.THREE;
}

function span(data) {
  const ends = [];
  if (data.body && data.body.time.length) ends.push(data.body.time[0], data.body.time.at(-1));
  else for (const path of data.paths) if (path.times.length) ends.push(path.times[0], path.times.at(-1));
  return ends.length ? [Math.min(...ends), Math.max(...ends)] : [0, 1];
}

function makeView(data) {
  const holder = section.querySelector(".solid");
  if (webgl()) {
    const view = new Solid(holder, data, loadThree());
    section.dataset.mode = "webgl";
    return view;
  }
  const message = section.querySelector(".nogl");
  message.textContent = "This browser has no WebGL, so the scene is shown from above and from the side instead of in 3D. "
    + "To turn it, open the page in a browser with hardware acceleration.";
  message.hidden = false;
  section.dataset.mode = "flat";
  return new Flat(holder, data);
}

function wireKeys(holder, view, timeline) {
  const keys = {
    " ": () => timeline.toggle(),
    ",": () => timeline.go(timeline.step - 1),
    ".": () => timeline.go(timeline.step + 1),
    ArrowLeft: () => view.orbit.turn(0.12, 0),
    ArrowRight: () => view.orbit.turn(-0.12, 0),
    ArrowUp: () => view.orbit.turn(0, 0.1),
    ArrowDown: () => view.orbit.turn(0, -0.1),
    "+": () => view.orbit.zoom(0.85),
    "=": () => view.orbit.zoom(0.85),
    "-": () => view.orbit.zoom(1 / 0.85),
    0: () => view.orbit.reset(),
  };
  holder.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
}

function wireControls(view, timeline) {
  const [slider, play, clock] = ["time", "play", "clock"].map((id) => document.getElementById(id));
  slider.max = timeline.steps;
  slider.addEventListener("input", () => timeline.go(Number(slider.value)));
  play.addEventListener("click", () => timeline.toggle());
  document.getElementById("speed").addEventListener("change", (event) => (timeline.speed = Number(event.target.value)));
  const follow = section.querySelector("[data-layer=follow]");
  document.getElementById("reset").addEventListener("click", () => {
    follow.checked = false;
    view.show("follow", false);
    view.orbit.reset();
  });
  for (const button of section.querySelectorAll("[data-look]")) {
    button.disabled = !view.look;
    button.addEventListener("click", () => {
      follow.checked = true;
      view.look(button.dataset.look);
    });
  }
  for (const box of section.querySelectorAll("[data-layer]")) {
    box.addEventListener("change", () => {
      view.show(box.dataset.layer, box.checked);
      timeline.go(timeline.step);
    });
  }
  timeline.onChange(() => {
    slider.value = timeline.step;
    clock.textContent = `${timeline.time.toFixed(2)} s`;
    slider.setAttribute("aria-valuetext", clock.textContent);
    play.textContent = timeline.playing ? "Pause" : "Play";
    play.setAttribute("aria-pressed", timeline.playing);
  });
}

function wirePicture(data, timeline) {
  const chooser = document.getElementById("camera");
  const now = document.getElementById("now");
  const picture = new Picture(section.querySelector(".picture"), data, (words) => (now.textContent = words));
  for (const camera of Object.keys(data.tones)) chooser.add(new Option(camera, camera));
  const first = data.pictures.find((each) => each.frames.length);
  if (first) chooser.value = first.camera;
  chooser.addEventListener("change", () => {
    picture.choose(chooser.value);
    timeline.go(timeline.step);
  });
  picture.choose(chooser.value);
  timeline.pace = () => picture.film.now();
  timeline.onChange(() => {
    // Screen readers read the text only while the film is paused; otherwise they would speak all the time.
    now.setAttribute("aria-live", timeline.playing ? "off" : "polite");
    picture.go(timeline.time, timeline.playing, timeline.speed);
  });
  return picture;
}

function wireStrips(timeline) {
  const strips = [...document.querySelectorAll("svg.strip")].map((svg) => {
    const [left, width, start, end] = ["left", "width", "start", "end"].map((key) => Number(svg.dataset[key]));
    svg.addEventListener("click", (event) => {
      const box = svg.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
      timeline.goTo(start + ((x - left) / width) * (end - start));
    });
    return { line: svg.querySelector(".now"), left, width, start, end };
  });
  timeline.onChange(() => {
    for (const { line, left, width, start, end } of strips) {
      const x = left + ((timeline.time - start) / (end - start || 1)) * width;
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
    }
  });
}

// Return the frames per second while the scene turns and plays; the benchmark uses it.
function measure(view, timeline, seconds) {
  return new Promise((resolve) => {
    const start = performance.now();
    let frames = 0;
    const tick = (now) => {
      view.orbit.turn(0.01, 0);
      timeline.go((timeline.step + 1) % (timeline.steps + 1));
      frames += 1;
      if (now - start < 1000 * seconds) requestAnimationFrame(tick);
      else resolve({ fps: (1000 * frames) / (now - start), share: view.share ?? 1 });
    };
    requestAnimationFrame(tick);
  });
}

if (section) {
  const data = unpack(raw);
  const timeline = new Timeline(...span(data), data.body ? data.body.fps : 30);
  const view = makeView(data);
  wireControls(view, timeline);
  timeline.onChange(() => view.go(timeline.time));
  const picture = wirePicture(data, timeline);
  wireStrips(timeline);
  wireKeys(section.querySelector(".solid"), view, timeline);
  const list = section.querySelector(".cameralist");
  for (const [camera, tone] of Object.entries(data.tones)) {
    const item = document.createElement("li");
    const dot = document.createElement("span");
    dot.className = "tone";
    dot.style.setProperty("--tone", tone);
    item.append(dot, camera);
    list.append(item);
  }
  timeline.go(0);
  if (data.body && view.look) {
    section.querySelector("[data-layer=follow]").checked = true;
    view.look("person");
    if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) timeline.toggle();
  }
  if (location.protocol !== "file:" && new URLSearchParams(location.search).has("videos")) {
    fetch("videos.json").then((answer) => answer.json()).then((videos) => {
      picture.useVideos(videos);
      timeline.go(timeline.step);
    });
  }
  window.bodycap = { data, timeline, view, picture, fps: (seconds) => measure(view, timeline, seconds) };
}
