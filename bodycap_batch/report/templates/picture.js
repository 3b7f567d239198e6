// What one camera saw at the time, with the points behind its pose and the skeleton drawn over it.
const SVG = "http://www.w3.org/2000/svg";

class Picture {
  constructor(figure, data) {
    this.figure = figure;
    this.data = data;
    this.frame = figure.querySelector(".frame");
    this.image = figure.querySelector("img");
    this.video = figure.querySelector("video");
    this.overlay = figure.querySelector("svg");
    this.missing = figure.querySelector(".nopicture");
    this.videos = {};
    this.shown = null;
  }

  choose(camera, time) {
    this.series = this.data.pictures.find((each) => each.camera === camera && each.frames.length);
    this.shown = null;
    const [width, height] = this.series ? this.series.size : [4, 3];
    this.frame.style.aspectRatio = `${width} / ${height}`;
    this.aspect = height / width;
    this.overlay.setAttribute("viewBox", `0 0 1 ${this.aspect}`);
    this.overlay.setAttribute("preserveAspectRatio", "none");
    this.image.hidden = !this.series;
    this.missing.hidden = Boolean(this.series);
    this.overlay.replaceChildren();
    this.video.hidden = true;
    this.go(time);
  }

  // Real videos, where `bodycap view` serves them: common and container time of a few frames each.
  offer(videos) {
    this.videos = videos;
    this.video.addEventListener("error", () => {
      this.videos = {};
      this.video.hidden = true;
      this.overlay.style.visibility = "visible";
    });
  }

  go(time) {
    if (!this.series) return "";
    const frame = this.series.frames[nearest(this.series.times, time)];
    if (frame !== this.shown) {
      this.shown = frame;
      this.image.src = `data:image/jpeg;base64,${frame.jpeg}`;
      this.image.alt = `${this.series.camera}, frame ${frame.i}`;
      this.mark(frame);
    }
    this.play(time);
    const pose = frame.status === "" ? "" : `, ${frame.status.toLowerCase().replaceAll("_", " ")}`;
    const numbers = frame.inliers && frame.error !== null ? `, ${frame.inliers} inliers, ${frame.error.toFixed(2)} px` : "";
    return `${this.series.camera}: picture of frame ${frame.i + 1} of ${this.series.count} at ${frame.t.toFixed(2)} s${pose}${numbers}`;
  }

  play(time) {
    const parts = this.videos[this.series.camera];
    if (!parts) return;
    const part = parts.findLast((each) => each.common[0] <= time) || parts[0];
    if (this.part !== part) {
      this.part = part;
      this.video.src = part.url;
    }
    this.video.hidden = false;
    const i = Math.min(before(part.common, time), Math.max(part.common.length - 2, 0));
    const j = Math.min(i + 1, part.common.length - 1);
    const span = part.common[j] - part.common[i];
    const share = span > 0 ? (time - part.common[i]) / span : 0;
    this.video.currentTime = part.container[i] + share * (part.container[j] - part.container[i]);
    const step = this.series.times.length > 1 ? 0.02 : 0;
    this.overlay.style.visibility = Math.abs(this.shown.t - time) <= step ? "visible" : "hidden";
  }

  mark(frame) {
    const marks = [];
    const inliers = scaled(frame.inliersAt);
    for (let i = 0; i < inliers.length; i += 2) {
      const dot = document.createElementNS(SVG, "circle");
      dot.setAttribute("class", "inlier");
      dot.setAttribute("cx", inliers[i]);
      dot.setAttribute("cy", inliers[i + 1] * this.aspect);
      dot.setAttribute("r", 0.006);
      marks.push(dot);
    }
    for (const bone of frame.bones) {
      const line = document.createElementNS(SVG, "polyline");
      line.setAttribute("class", "bone");
      line.setAttribute("points", bone.map((value, i) => (i % 2 ? value * this.aspect : value)).join(" "));
      marks.push(line);
    }
    this.overlay.replaceChildren(...marks);
  }
}
