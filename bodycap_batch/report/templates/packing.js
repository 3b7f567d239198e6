// Unpacks the arrays in the page's data: base64 to numbers.
const NONE = 65535;

function bytesOf(text) {
  const raw = atob(text);
  const out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

// Return the numbers of 16-bit codes between the smallest and largest value of each column; NaN if missing.
function scaled(block) {
  const codes = new Uint16Array(bytesOf(block.u16).buffer);
  const columns = block.low.length;
  const out = new Float32Array(codes.length);
  for (let i = 0; i < codes.length; i++) {
    const column = i % columns;
    out[i] = codes[i] === NONE ? NaN : block.low[column] + codes[i] * block.step[column];
  }
  return out;
}

// Return the index of the last time that is at most t, or 0 if all times are after t. The times increase.
function before(times, t) {
  let low = 0;
  let high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle - 1;
  }
  return low;
}

function nearest(times, t) {
  const i = before(times, t);
  return i + 1 < times.length && times[i + 1] - t < t - times[i] ? i + 1 : i;
}

// Interpolate linearly between points (xs, ys) and return the value at t. The xs increase. Values of t before
// the first point or after the last point are extrapolated.
function between(xs, ys, t) {
  const i = Math.min(before(xs, t), Math.max(xs.length - 2, 0));
  const j = Math.min(i + 1, xs.length - 1);
  const span = xs[j] - xs[i];
  return span > 0 ? ys[i] + ((t - xs[i]) / span) * (ys[j] - ys[i]) : ys[i];
}

function unpack(data) {
  const body = data.solid.body;
  return {
    ...data,
    points: scaled(data.solid.points),
    colours: bytesOf(data.solid.colours.u8),
    paths: data.solid.paths.map((path) => ({
      camera: path.camera,
      tone: data.tones[path.camera],
      times: scaled(path.time),
      centre: scaled(path.centre),
      quat: scaled(path.quat),
      keyframe: bytesOf(path.keyframe.u8),
    })),
    body: body && {
      ...body,
      count: body.parents.length,
      centres: scaled(body.centres),
      observed: bytesOf(body.observed.u8),
      sigma: body.sigma && scaled(body.sigma),
    },
    pictures: data.pictures.map((each) => ({ ...each, times: each.frames.map((frame) => frame.t) })),
  };
}

// Interpolate the joint centres at a time into `out`, and return the nearer tick.
function bodyAt(body, t, out) {
  const i = before(body.time, t);
  const j = Math.min(i + 1, body.time.length - 1);
  const span = body.time[j] - body.time[i];
  const share = span > 0 ? Math.min(Math.max((t - body.time[i]) / span, 0), 1) : 0;
  const size = 3 * body.count;
  for (let k = 0; k < size; k++) {
    out[k] = body.centres[i * size + k] * (1 - share) + body.centres[j * size + k] * share;
  }
  return share < 0.5 ? i : j;
}

// Return the index of a camera's pose at a time, or −1 if the camera has no pose at this time.
function poseAt(path, t) {
  if (!path.times.length) return -1;
  const i = nearest(path.times, t);
  const step = path.times.length > 1 ? (path.times[path.times.length - 1] - path.times[0]) / (path.times.length - 1) : 1;
  return Math.abs(path.times[i] - t) <= step && Number.isFinite(path.centre[3 * i]) ? i : -1;
}
