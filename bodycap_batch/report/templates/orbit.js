// A camera that orbits a point, Z up. Dragging turns it, shift-dragging or two fingers move it, and the wheel or a
// pinch zooms.
const FILLED = 0.92; // share of the picture that the first view fills

class Orbit {
  constructor(view, onChange) {
    this.home = { target: [...view.centre], distance: 2.1 * view.radius, azimuth: -1.1, height: 0.42 };
    this.onChange = onChange;
    this.radius = view.radius;
    this.reset();
  }

  // Set the first view so that all points (x, y, z in sequence) are visible, unless the user has changed the view.
  frame(points, aspect, view) {
    const high = Math.tan((0.5 * view * Math.PI) / 180) * FILLED;
    const [low, top] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    points.forEach((value, i) => {
      low[i % 3] = Math.min(low[i % 3], value);
      top[i % 3] = Math.max(top[i % 3], value);
    });
    const { home } = this;
    if (points.length) home.target = low.map((value, axis) => 0.5 * (value + top[axis]));
    const [sin, cos] = [Math.sin(home.azimuth), Math.cos(home.azimuth)];
    const [rise, level] = [Math.sin(home.height), Math.cos(home.height)];
    let distance = points.length ? 0.5 * this.radius : home.distance;
    for (let i = 0; i < points.length; i += 3) {
      const [x, y, z] = home.target.map((value, axis) => points[i + axis] - value);
      const near = level * (cos * x + sin * y) + rise * z;
      const across = Math.abs(cos * y - sin * x) / (high * aspect);
      const up = Math.abs(level * z - rise * (cos * x + sin * y)) / high;
      distance = Math.max(distance, near + Math.max(across, up));
    }
    home.distance = distance;
    if (this.untouched) this.reset();
  }

  reset() {
    Object.assign(this, this.home, { target: [...this.home.target], untouched: true });
    this.onChange();
  }

  // Look at a place from a direction and a distance.
  look(target, distance, azimuth, height) {
    Object.assign(this, { target: [...target], distance, azimuth, height, untouched: false });
    this.onChange();
  }

  turn(azimuth, height) {
    this.untouched = false;
    this.azimuth += azimuth;
    this.height = Math.min(Math.max(this.height + height, -1.5), 1.5);
    this.onChange();
  }

  zoom(factor) {
    this.untouched = false;
    this.distance = Math.min(Math.max(this.distance * factor, 0.02 * this.radius), 60 * this.radius);
    this.onChange();
  }

  move(right, up) {
    this.untouched = false;
    const [sin, cos] = [Math.sin(this.azimuth), Math.cos(this.azimuth)];
    const scale = this.distance;
    this.target[0] += scale * (-right * sin - up * Math.sin(this.height) * cos);
    this.target[1] += scale * (right * cos - up * Math.sin(this.height) * sin);
    this.target[2] += scale * up * Math.cos(this.height);
    this.onChange();
  }

  eye() {
    const flat = this.distance * Math.cos(this.height);
    return [
      this.target[0] + flat * Math.cos(this.azimuth),
      this.target[1] + flat * Math.sin(this.azimuth),
      this.target[2] + this.distance * Math.sin(this.height),
    ];
  }

  listen(element) {
    const held = new Map();
    element.addEventListener("pointerdown", (event) => {
      held.set(event.pointerId, [event.clientX, event.clientY]);
      element.setPointerCapture(event.pointerId);
    });
    const release = (event) => held.delete(event.pointerId);
    element.addEventListener("pointerup", release);
    element.addEventListener("pointercancel", release);
    element.addEventListener("pointermove", (event) => {
      const from = held.get(event.pointerId);
      if (!from) return;
      const size = element.clientHeight || 1;
      const dx = (event.clientX - from[0]) / size;
      const dy = (event.clientY - from[1]) / size;
      if (held.size === 2) {
        const other = [...held].find(([id]) => id !== event.pointerId)[1];
        const was = Math.hypot(from[0] - other[0], from[1] - other[1]);
        const is = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
        if (is > 0) this.zoom(was / is);
        this.move(-dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons === 2 || event.buttons === 4) this.move(-dx, dy);
      else this.turn(-3 * dx, 3 * dy);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(Math.min(Math.max(event.deltaY, -200), 200) * 0.0015));
      },
      { passive: false },
    );
  }
}
