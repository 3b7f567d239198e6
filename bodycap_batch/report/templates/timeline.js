// The common clock of viewer, picture and camera timelines.
class Timeline {
  constructor(start, end, fps) {
    this.start = start;
    this.fps = fps;
    this.steps = Math.max(1, Math.round((end - start) * fps));
    this.step = 0;
    this.speed = 1;
    this.playing = false;
    this.listeners = [];
    this.pace = () => null;
  }

  get time() {
    return this.start + this.step / this.fps;
  }

  onChange(listener) {
    this.listeners.push(listener);
  }

  go(step) {
    this.step = Math.min(Math.max(Math.round(step), 0), this.steps);
    for (const listener of this.listeners) listener(this);
  }

  goTo(time) {
    this.go((time - this.start) * this.fps);
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing) {
      if (this.step >= this.steps) this.step = 0;
      this.last = null;
      this.carry = 0;
      requestAnimationFrame((now) => this.tick(now));
    }
    for (const listener of this.listeners) listener(this);
  }

  tick(now) {
    if (!this.playing) return;
    if (this.last !== null) this.carry += ((now - this.last) / 1000) * this.fps * this.speed;
    this.last = now;
    // If a video plays, its clock sets the time.
    const paced = this.pace();
    if (paced !== null) this.carry = Math.max(0, (paced - this.start) * this.fps - this.step);
    const whole = Math.floor(this.carry);
    this.carry -= whole;
    if (whole) {
      if (this.step + whole >= this.steps) this.playing = false;
      this.go(this.step + whole);
    }
    requestAnimationFrame((later) => this.tick(later));
  }
}
