// The frame of one camera at the current time, with the inlier points of its pose and the skeleton as overlay.
const SVG = "http://www.w3.org/2000/svg";

class Picture {
  constructor(figure, data, showText) {
    this.data = data;
    this.showText = showText;
    this.frame = figure.querySelector(".frame");
    this.image = figure.querySelector("img");
    this.overlay = figure.querySelector("svg");
    this.missing = figure.querySelector(".nopicture");
    this.noFilm = figure.querySelector(".nofilm");
    this.lines = Object.fromEntries(["edge", "inlier", "bone"].map((name) => [name, this.line(name)]));
    this.videos = { each: 1, cameras: {} };
    this.shown = null;
    this.film = new Film(
      figure.querySelector("video"),
      (index) => this.onVideoFrame(index),
      () => {
        delete this.videos.cameras[this.camera];
        this.noFilm.textContent = `This browser does not play the video of ${this.camera}. Small pictures are shown instead.`;
        this.noFilm.hidden = false;
      },
    );
  }

  line(name) {
    const path = document.createElementNS(SVG, "path");
    path.setAttribute("class", name);
    this.overlay.append(path);
    return path;
  }

  choose(camera) {
    this.camera = camera;
    this.series = this.data.pictures.find((each) => each.camera === camera && each.frames.length);
    const [width, height] = this.series ? this.series.size : [4, 3];
    this.frame.style.aspectRatio = `${width} / ${height}`;
    this.aspect = height / width;
    this.overlay.setAttribute("viewBox", `0 0 1 ${this.aspect}`);
    this.overlay.setAttribute("preserveAspectRatio", "none");
    this.image.hidden = !this.series;
    this.missing.hidden = Boolean(this.series);
    this.drawOverlay(null);
    this.noFilm.hidden = true;
    this.overlays = new Map();
    this.film.load((this.series && this.videos.cameras[camera]) || []);
  }

  // Use real videos; the overlays of their frames come in parts of `videos.each` frames.
  useVideos(videos) {
    this.videos = videos;
    this.choose(this.camera);
  }

  go(time, playing, speed) {
    if (!this.series) return;
    if (this.film.active) {
      this.film.go(time, playing, speed);
      return;
    }
    const frame = this.series.frames[nearest(this.series.times, time)];
    if (frame === this.shown) return;
    this.image.src = `data:image/jpeg;base64,${frame.jpeg}`;
    this.image.alt = `${this.camera}, frame ${frame.i}`;
    this.drawOverlay(frame);
  }

  // Draw the overlay of the displayed video frame. If this overlay is not loaded, draw the overlay of a stored
  // picture of the same frame. Without such a picture, draw no overlay.
  onVideoFrame(index) {
    if (!this.film.active) return;
    this.index = index;
    const part = Math.floor(index / this.videos.each);
    for (const each of [part, part + 1]) this.fetchOverlays(each);
    const found = this.overlays.get(part);
    const known = Array.isArray(found) ? found[index - part * this.videos.each] : null;
    this.drawOverlay(known || this.series.frames.find((frame) => frame.i === index) || { i: index });
  }

  fetchOverlays(part) {
    const { overlays, camera } = this;
    if (overlays.has(part) || part * this.videos.each >= this.series.count) return;
    overlays.set(part, null);
    const number = Object.keys(this.videos.cameras).indexOf(camera);
    fetch(`marks/${number}/${part}.json`)
      .then((answer) => (answer.ok ? answer.json() : null))
      .then((found) => {
        overlays.set(part, found);
        if (found && this.overlays === overlays && Math.floor(this.index / this.videos.each) === part) this.onVideoFrame(this.index);
      });
  }

  drawOverlay(frame) {
    if (frame === this.shown) return;
    this.shown = frame;
    const at = (x, y) => `${x.toFixed(4)} ${(y * this.aspect).toFixed(4)}`;
    const [dots, bones] = [[], []];
    const inliers = frame && frame.inliersAt ? scaled(frame.inliersAt) : [];
    // A line of length zero with round ends is a dot.
    for (let i = 0; i < inliers.length; i += 2) dots.push(`M${at(inliers[i], inliers[i + 1])}h0`);
    for (const bone of (frame && frame.bones) || []) {
      for (let i = 0; i < bone.length; i += 2) bones.push(`${i ? "L" : "M"}${at(bone[i], bone[i + 1])}`);
    }
    for (const name of ["edge", "inlier"]) this.lines[name].setAttribute("d", dots.join(""));
    this.lines.bone.setAttribute("d", bones.join(""));
    if (frame) this.frame.dataset.index = frame.i;
    if (frame) this.showText(this.describe(frame));
  }

  describe(frame) {
    const what = this.film.active ? "frame" : "picture of frame";
    const when = frame.t === undefined ? "" : ` at ${frame.t.toFixed(2)} s`;
    const pose = frame.status ? `, ${frame.status.toLowerCase().replaceAll("_", " ")}` : "";
    const known = frame.inliers && frame.error !== null;
    const numbers = known ? `, ${frame.inliers} inliers, ${frame.error.toFixed(2)} px` : "";
    return `${this.camera}: ${what} ${frame.i + 1} of ${this.series.count}${when}${pose}${numbers}`;
  }
}
