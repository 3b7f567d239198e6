// The scene without WebGL: from above and from the side, on a 2D canvas.
class Flat {
  constructor(holder, data) {
    this.data = data;
    this.holder = holder;
    this.hidden = new Set();
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "Room, camera paths and body from above (left) and from the side (right)");
    holder.append(this.canvas);
    this.centres = data.body && new Float32Array(3 * data.body.count);
    this.time = 0;
    const orbit = { distance: 1, zoom: (factor) => this.zoom(factor), turn: () => {}, reset: () => this.zoom(0) };
    this.scale = 1;
    this.orbit = orbit;
    holder.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.0015));
    }, { passive: false });
    new ResizeObserver(() => this.resize()).observe(holder);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.resize());
    this.resize();
  }

  zoom(factor) {
    this.scale = factor === 0 ? 1 : Math.min(Math.max(this.scale / factor, 0.2), 20);
    this.resize();
  }

  show(name, on) {
    if (on) this.hidden.delete(name);
    else this.hidden.add(name);
    this.resize();
  }

  go(time) {
    this.time = time;
    this.draw();
  }

  // From above: x to the right, y up. From the side: y to the right, z up.
  views() {
    const { width, height } = this.canvas;
    const half = width / 2;
    const pixels = (0.42 * Math.min(half, height) * this.scale) / this.data.solid.view.radius;
    const [x, y, z] = this.data.solid.view.centre;
    return [
      { name: "from above", left: 0, at: (p, i) => [half / 2 + (p[i] - x) * pixels, height / 2 - (p[i + 1] - y) * pixels] },
      { name: "from the side", left: half, at: (p, i) => [1.5 * half + (p[i + 1] - y) * pixels, height / 2 - (p[i + 2] - z) * pixels] },
    ];
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.ratio = ratio;
    this.canvas.width = Math.max(2, Math.round(this.holder.clientWidth * ratio));
    this.canvas.height = Math.max(2, Math.round(this.holder.clientHeight * ratio));
    this.background = document.createElement("canvas");
    this.background.width = this.canvas.width;
    this.background.height = this.canvas.height;
    const pen = this.background.getContext("2d");
    for (const view of this.views()) this.clipped(pen, view, () => this.drawBackground(pen, view));
    this.draw();
  }

  clipped(pen, view, work) {
    pen.save();
    pen.beginPath();
    pen.rect(view.left, 0, this.canvas.width / 2, this.canvas.height);
    pen.clip();
    work();
    pen.restore();
  }

  drawBackground(pen, view) {
    const { points, colours, paths } = this.data;
    const dot = 1.6 * this.ratio;
    if (!this.hidden.has("points")) {
      for (let i = 0; i < points.length; i += 3) {
        const [x, y] = view.at(points, i);
        pen.fillStyle = `rgb(${colours[i]},${colours[i + 1]},${colours[i + 2]})`;
        pen.fillRect(x, y, dot, dot);
      }
    }
    for (const path of paths) {
      pen.fillStyle = path.tone;
      for (let i = 0; i < path.times.length; i++) {
        if (!Number.isFinite(path.centre[3 * i])) continue;
        const [x, y] = view.at(path.centre, 3 * i);
        const key = path.keyframe[i] && !this.hidden.has("keyframes");
        const size = (key ? 4 : 2) * this.ratio;
        if (key || !this.hidden.has("paths")) pen.fillRect(x - size / 2, y - size / 2, size, size);
      }
    }
    pen.fillStyle = styleColour("--soft");
    pen.font = `${12 * this.ratio}px system-ui, sans-serif`;
    pen.fillText(view.name, view.left + 10 * this.ratio, 18 * this.ratio);
  }

  draw() {
    const pen = this.canvas.getContext("2d");
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.drawImage(this.background, 0, 0);
    pen.fillStyle = styleColour("--line");
    pen.fillRect(this.canvas.width / 2, 0, this.ratio, this.canvas.height);
    const { body, paths } = this.data;
    const tick = body ? bodyAt(body, this.time, this.centres) : 0;
    for (const view of this.views()) {
      this.clipped(pen, view, () => {
        if (!this.hidden.has("cameras")) for (const path of paths) this.drawCamera(pen, view, path);
        if (body && !this.hidden.has("body")) this.drawBody(pen, view, body);
        if (body && body.sigma && !this.hidden.has("sigma")) this.drawSigma(pen, view, body, tick);
      });
    }
  }

  drawCamera(pen, view, path) {
    const i = poseAt(path, this.time);
    if (i < 0) return;
    const [x, y] = view.at(path.centre, 3 * i);
    pen.fillStyle = path.tone;
    pen.beginPath();
    pen.arc(x, y, 6 * this.ratio, 0, 2 * Math.PI);
    pen.fill();
  }

  drawBody(pen, view, body) {
    const jointIsSolved = (joint) => (joint < body.solved.length ? body.solved[joint] : body.solved[body.parents[joint]]);
    pen.lineCap = "round";
    body.parents.forEach((parent, child) => {
      if (parent < 0) return;
      const isSolved = jointIsSolved(parent) && jointIsSolved(child);
      pen.strokeStyle = styleColour(isSolved ? "--ink" : "--soft");
      pen.lineWidth = (isSolved ? 4 : 2) * this.ratio;
      pen.beginPath();
      pen.moveTo(...view.at(this.centres, 3 * parent));
      pen.lineTo(...view.at(this.centres, 3 * child));
      pen.stroke();
    });
  }

  drawSigma(pen, view, body, tick) {
    const count = body.joints.length;
    const unit = Math.abs(view.at([0, 1, 0], 0)[1] - view.at([0, 0, 0], 0)[1]) || Math.abs(view.at([0, 1, 0], 0)[0] - view.at([0, 0, 0], 0)[0]);
    pen.fillStyle = "rgba(208, 138, 26, 0.3)";
    for (let joint = 0; joint < count; joint++) {
      const radius = body.sigma[tick * count + joint];
      if (!Number.isFinite(radius)) continue;
      pen.beginPath();
      pen.arc(...view.at(this.centres, 3 * joint), Math.max(radius * unit, 1), 0, 2 * Math.PI);
      pen.fill();
    }
  }
}
