// The points of the map without a graphics card. A software renderer needs more than a microsecond for each
// point; plain arithmetic on pixels needs a tenth of that. Its canvas is behind the rest of the scene.
class Splat {
  constructor(holder, points, colours) {
    this.points = points;
    this.visible = true;
    this.tones = new Uint32Array(points.length / 3);
    for (let i = 0; i < this.tones.length; i++) {
      this.tones[i] = (255 << 24) | (colours[3 * i + 2] << 16) | (colours[3 * i + 1] << 8) | colours[3 * i];
    }
    this.canvas = document.createElement("canvas");
    this.pen = this.canvas.getContext("2d");
    holder.append(this.canvas);
    // The element that contains it may have no size yet.
    this.resize(1, 1);
  }

  resize(width, height) {
    this.canvas.width = width;
    this.canvas.height = height;
    this.image = this.pen.createImageData(width, height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.depths = new Float32Array(width * height);
  }

  // Draw the first `count` points, two pixels wide; nearer points hide farther ones. Matrix: world to clip space.
  draw(matrix, count) {
    const { points, tones, pixels, depths } = this;
    const { width, height } = this.canvas;
    pixels.fill(0);
    depths.fill(Infinity);
    const [a, b, , c, d, e, , f, g, h, , k, l, m, , n] = matrix;
    for (let i = 0, j = 0; this.visible && i < count; i++, j += 3) {
      const x = points[j];
      const y = points[j + 1];
      const z = points[j + 2];
      const depth = c * x + f * y + k * z + n;
      if (!(depth > 0)) continue;
      const column = ((a * x + d * y + g * z + l) / depth + 1) * 0.5 * width - 0.5;
      const row = (1 - (b * x + e * y + h * z + m) / depth) * 0.5 * height - 0.5;
      if (!(column >= 0 && row >= 0 && column < width - 1 && row < height - 1)) continue;
      const first = (row | 0) * width + (column | 0);
      for (let at = first; at <= first + width; at += width) {
        for (let there = at; there < at + 2; there++) {
          if (depth >= depths[there]) continue;
          depths[there] = depth;
          pixels[there] = tones[i];
        }
      }
    }
    this.pen.putImageData(this.image, 0, 0);
  }
}
