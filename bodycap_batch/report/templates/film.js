// The real video of a camera, if `bodycap view` serves it. While it plays, the page follows the video's clock,
// so there is no seek for each frame. The overlay is that of the displayed frame.
const SLACK_S = 0.15; // largest difference between video and page without a seek, seconds

class Film {
  constructor(video, onFrame, onFailure) {
    this.video = video;
    this.onFrame = onFrame;
    this.parts = [];
    this.part = null;
    this.wanted = null;
    this.frameIsPending = false;
    // A browser in data saving mode may decode no frame before a seek. Therefore each of these events is handled.
    for (const event of ["loadedmetadata", "loadeddata", "seeked"]) video.addEventListener(event, () => this.afterSeek());
    video.addEventListener("error", () => {
      if (!this.part) return;
      this.load([]);
      onFailure();
    });
    this.watch();
  }

  get active() {
    return this.parts.length > 0;
  }

  // Load the chapters of a camera; each has the common time and the time in the file of its frames.
  load(parts) {
    this.parts = parts;
    this.part = null;
    this.wanted = null;
    this.video.hidden = !parts.length;
    this.video.removeAttribute("src");
    this.video.load();
  }

  watch() {
    const { video } = this;
    const report = (seconds) => {
      if (this.part && video.readyState >= 2) {
        this.frameIsPending = false;
        this.show(seconds);
      }
      this.watch();
    };
    if (video.requestVideoFrameCallback) {
      video.requestVideoFrameCallback((_, frame) => report(frame.mediaTime + (this.part ? this.part.half : 0)));
    } else requestAnimationFrame(() => report(video.currentTime));
  }

  show(seconds) {
    this.onFrame(this.part.first + nearest(this.part.container, seconds));
  }

  go(time, playing, speed) {
    const part = this.parts.findLast((each) => each.common[0] <= time) || this.parts[0];
    if (!part) return;
    if (part !== this.part) {
      this.part = part;
      this.video.src = part.url;
      this.frameIsPending = true;
    }
    const videoTime = between(part.common, part.container, time);
    const inside = time >= part.common[0] && time <= part.common.at(-1) + 2 * part.half;
    if (!playing || !inside) {
      this.video.pause();
      this.seek(videoTime);
      return;
    }
    this.video.playbackRate = speed;
    if (Math.abs(this.video.currentTime - videoTime) > SLACK_S) this.seek(videoTime);
    // The browser rejects the call of `play` if a pause or a new chapter interrupts it. The next step calls it again.
    if (this.video.paused && !this.video.ended) this.video.play().catch(() => {});
  }

  seek(seconds) {
    if (this.video.seeking || this.video.readyState < 1) this.wanted = seconds;
    else if (Math.abs(this.video.currentTime - seconds) > 1e-4) {
      this.frameIsPending = true;
      this.video.currentTime = seconds;
    }
  }

  // The frame of a seek can be displayed before the video reports it. Therefore it is handled when the seek ends.
  afterSeek() {
    const { video, part, wanted } = this;
    this.wanted = null;
    if (wanted !== null) this.seek(wanted);
    if (part && this.frameIsPending && !video.seeking && video.readyState >= 2) this.show(video.currentTime);
  }

  // Return the common time of the video; null while it does not play, because then the page uses its own clock.
  now() {
    const { video, part } = this;
    if (!part || video.paused || video.ended) return null;
    if (video.seeking || video.readyState < 2) return -Infinity;
    return between(part.container, part.common, video.currentTime);
  }
}
