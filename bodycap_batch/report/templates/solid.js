// The 3D view, drawn by three.js only when something has changed.
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;
// Times in milliseconds. While something moves, fewer points are drawn if two frames are more than SLOW_MS apart,
// and more points are drawn if they are less than FAST_MS apart. After STILL_MS without a change all points are
// drawn.
const [SLOW_MS, FAST_MS, STILL_MS] = [31, 20, 250];
// This shader draws only points with a colour. The material of three.js takes twice as long without a graphics card.
const POINT_SHADER = `
in vec3 position;
in vec3 color;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform float size;
out vec3 tone;
void main() {
  tone = color;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size;
}`;
const COLOUR_SHADER = `
precision mediump float;
in vec3 tone;
out vec4 colour;
void main() {
  colour = vec4(tone, 1.0);
}`;

function styleColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

const PERSON_MARGIN = 1.25; // height of the view of a person, in heights of the person

class Solid {
  constructor(holder, data, three) {
    this.three = three;
    this.data = data;
    this.holder = holder;
    this.layers = {};
    this.dirty = true;
    this.follow = false;
    this.renderer = new three.WebGLRenderer({ antialias: false, alpha: true, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = three.LinearSRGBColorSpace;
    const gl = this.renderer.getContext();
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    this.gpu = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    this.renderer.setPixelRatio(SOFTWARE.test(this.gpu) ? 1 : Math.min(window.devicePixelRatio || 1, 2));
    if (SOFTWARE.test(this.gpu)) this.splat = new Splat(holder, data.points, data.colours);
    holder.append(this.renderer.domElement);
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(42, 16 / 9, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.clip = new three.Matrix4();
    this.scene.add(new three.HemisphereLight(0xffffff, 0x777777, 2.2));
    const sun = new three.DirectionalLight(0xffffff, 1.2);
    sun.position.set(2, -3, 5);
    this.scene.add(sun);
    this.orbit = new Orbit(data.solid.view, () => (this.dirty = true));
    this.orbit.listen(holder);
    this.firstViewPoints = this.pointsInFirstView();
    this.unit = data.solid.metric ? 1 : data.solid.view.radius / 2.5;
    this.addPoints();
    this.addPaths();
    if (data.body) this.addBody();
    new ResizeObserver(() => this.resize()).observe(holder);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.applyColours());
    this.applyColours();
    this.resize();
    this.share = 1;
    this.adapts = true;
    this.drawn = -1000;
    const loop = (now) => {
      if (this.dirty) this.render(now, true);
      else if (this.thin && now - this.drawn > STILL_MS) this.render(now, false);
      requestAnimationFrame(loop);
    };
    requestAnimationFrame(loop);
  }

  // Return the points that the first view must show: the body at all times, and the camera paths without their
  // distant parts; without a body, the near points of the room, too.
  pointsInFirstView() {
    const { body, paths, points, solid } = this.data;
    const out = [];
    if (body) {
      const ticks = body.centres.length / (3 * body.count);
      const step = Math.max(1, Math.floor(ticks / 100));
      for (let tick = 0; tick < ticks; tick += step) {
        out.push(...body.centres.subarray(3 * body.count * tick, 3 * body.count * (tick + 1)));
      }
    }
    const { centre, radius } = solid.view;
    for (const path of paths) {
      const step = Math.max(1, Math.floor(path.times.length / 200));
      for (let i = 0; i < path.times.length; i += step) {
        const place = [...path.centre.subarray(3 * i, 3 * i + 3)];
        if (Math.hypot(...place.map((value, axis) => value - centre[axis])) < 2 * radius) out.push(...place);
      }
    }
    // The points are in random order.
    for (let i = 0; !body && i < Math.min(points.length, 3 * 500); i += 3) {
      const place = [...points.subarray(i, i + 3)];
      if (Math.hypot(...place.map((value, axis) => value - centre[axis])) < 1.5 * radius) out.push(...place);
    }
    return out;
  }

  layer(name, object) {
    (this.layers[name] = this.layers[name] || []).push(object);
    this.scene.add(object);
    return object;
  }

  show(name, on) {
    if (name === "follow") this.follow = on;
    for (const object of this.layers[name] || []) object.visible = on;
    this.dirty = true;
  }

  buffer(values, size, normalised = false) {
    return new this.three.BufferAttribute(values, size, normalised);
  }

  addPoints() {
    const { three, data } = this;
    if (this.splat) this.layers.points = [this.splat];
    else {
      const cloud = new three.BufferGeometry();
      cloud.setAttribute("position", this.buffer(data.points, 3));
      cloud.setAttribute("color", this.buffer(data.colours, 3, true));
      this.cloud = cloud;
      this.layer("points", new three.Points(cloud, this.dots(2))).frustumCulled = false;
    }
    if (data.solid.metric) {
      const [x, y] = data.solid.view.centre;
      const side = 2 * Math.ceil(2 * data.solid.view.radius);
      this.grid = new three.GridHelper(side, side, 0x888888, 0x888888);
      this.grid.rotation.x = Math.PI / 2;
      this.grid.position.set(Math.round(x), Math.round(y), 0);
      this.grid.material.transparent = true;
      this.grid.material.opacity = 0.22;
      this.scene.add(this.grid);
    }
  }

  dots(size) {
    return new this.three.RawShaderMaterial({
      vertexShader: POINT_SHADER,
      fragmentShader: COLOUR_SHADER,
      glslVersion: this.three.GLSL3,
      uniforms: { size: { value: size * this.renderer.getPixelRatio() } },
    });
  }

  // All cameras are one object, because each object takes time in a software renderer.
  addPaths() {
    const { three } = this;
    const [dots, dotTones, axes, axisTones] = [[], [], [], []];
    const rotation = new three.Quaternion();
    for (const path of this.data.paths) {
      const tone = new three.Color().setStyle(path.tone, three.LinearSRGBColorSpace).toArray();
      for (let i = 0; i < path.times.length; i++) {
        const centre = path.centre.subarray(3 * i, 3 * i + 3);
        if (!Number.isFinite(centre[0])) continue;
        dots.push(...centre);
        dotTones.push(...tone);
        if (!path.keyframe[i]) continue;
        rotation.set(...path.quat.subarray(4 * i, 4 * i + 4)).normalize();
        for (const axis of [0, 1, 2]) {
          const tip = new three.Vector3().setComponent(axis, 0.07 * this.unit).applyQuaternion(rotation);
          axes.push(...centre, centre[0] + tip.x, centre[1] + tip.y, centre[2] + tip.z);
          const shade = [0.85 * (axis === 0), 0.65 * (axis === 1), 0.95 * (axis === 2)];
          axisTones.push(...shade, ...shade);
        }
      }
    }
    this.layer("paths", new three.Points(this.shape(dots, dotTones), this.dots(3))).frustumCulled = false;
    const thin = new three.LineBasicMaterial({ vertexColors: true });
    this.layer("keyframes", new three.LineSegments(this.shape(axes, axisTones), thin)).frustumCulled = false;
    this.addFrusta(thin);
  }

  shape(positions, tones) {
    const geometry = new this.three.BufferGeometry();
    geometry.setAttribute("position", this.buffer(new Float32Array(positions), 3));
    geometry.setAttribute("color", this.buffer(new Float32Array(tones), 3));
    return geometry;
  }

  // Add a pyramid for each camera. The base of the pyramid is the image. The corners are moved one by one.
  addFrusta(material) {
    const { three } = this;
    const [w, h, d] = [0.1, 0.07, 0.15].map((each) => each * this.unit);
    const corners = [[-w, -h, d], [w, -h, d], [w, h, d], [-w, h, d]];
    this.pyramid = corners.flatMap((corner, i) => [[0, 0, 0], corner, corner, corners[(i + 1) % 4]]);
    const tones = this.data.paths.flatMap((path) => {
      const tone = new three.Color().setStyle(path.tone, three.LinearSRGBColorSpace).toArray();
      return this.pyramid.flatMap(() => tone);
    });
    this.frusta = this.shape(new Array(tones.length).fill(0), tones);
    this.layer("cameras", new three.LineSegments(this.frusta, material)).frustumCulled = false;
  }

  moveFrusta(time) {
    const { three } = this;
    const position = this.frusta.attributes.position;
    const [turn, corner, centre] = [new three.Quaternion(), new three.Vector3(), new three.Vector3()];
    let vertex = 0;
    for (const path of this.data.paths) {
      const i = poseAt(path, time);
      if (i >= 0) {
        turn.set(...path.quat.subarray(4 * i, 4 * i + 4)).normalize();
        centre.fromArray(path.centre, 3 * i);
      }
      for (const point of this.pyramid) {
        corner.fromArray(i >= 0 ? point : [0, 0, 0]);
        if (i >= 0) corner.applyQuaternion(turn).add(centre);
        position.setXYZ(vertex++, corner.x, corner.y, corner.z);
      }
    }
    position.needsUpdate = true;
  }

  addBody() {
    const { three, data } = this;
    const { parents, solved, sigma, joints } = data.body;
    this.centres = new Float32Array(3 * data.body.count);
    this.bones = parents.map((parent, child) => [parent, child]).filter(([parent]) => parent >= 0);
    const jointIsSolved = (joint) => (joint < solved.length ? solved[joint] : solved[parents[joint]]);
    const bone = new three.CylinderGeometry(0.022, 0.038, 1, 6, 1, true);
    bone.translate(0, 0.5, 0);
    const balls = parents.map((_, joint) => joint).filter((joint) => joint < joints.length);
    const material = new three.MeshLambertMaterial();
    this.meshes = {
      material,
      balls,
      boneIsSolved: this.bones.map(([parent, child]) => jointIsSolved(parent) && jointIsSolved(child)),
      ballIsSolved: balls.map(jointIsSolved),
      boneMesh: this.layer("body", new three.InstancedMesh(bone, material, this.bones.length)),
      ballMesh: this.layer("body", new three.InstancedMesh(new three.SphereGeometry(0.045, 8, 6), material, balls.length)),
    };
    this.meshes.boneMesh.frustumCulled = this.meshes.ballMesh.frustumCulled = false;
    if (sigma) {
      const material = new three.MeshLambertMaterial({ color: 0xd08a1a, transparent: true, opacity: 0.28, depthWrite: false });
      this.sigmaMesh = this.layer("sigma", new three.InstancedMesh(new three.SphereGeometry(1, 14, 10), material, joints.length));
      this.sigmaMesh.frustumCulled = false;
    }
  }

  applyColours() {
    this.renderer.setClearColor(styleColour("--view"), this.splat ? 0 : 1);
    if (this.meshes) {
      const read = (name) => new this.three.Color().setStyle(styleColour(name), this.three.LinearSRGBColorSpace);
      const [solvedColour, unsolvedColour] = [read("--bone"), read("--guess")];
      this.meshes.boneIsSolved.forEach((isSolved, index) => this.meshes.boneMesh.setColorAt(index, isSolved ? solvedColour : unsolvedColour));
      this.meshes.ballIsSolved.forEach((isSolved, index) => this.meshes.ballMesh.setColorAt(index, isSolved ? solvedColour : unsolvedColour));
      this.meshes.boneMesh.instanceColor.needsUpdate = this.meshes.ballMesh.instanceColor.needsUpdate = true;
    }
    this.dirty = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    if (this.splat) this.splat.resize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    const { target } = this.orbit;
    this.orbit.frame(this.firstViewPoints, width / height, this.camera.fov);
    if (this.follow) this.orbit.target = target;
    this.dirty = true;
  }

  // Return the greatest height of the person from the soles to the top of the head, so that a person who stands up
  // stays in the view.
  personHeight() {
    const { centres, count } = this.data.body;
    let height = 0;
    for (let start = 0; start < centres.length; start += 3 * count) {
      let [low, high] = [Infinity, -Infinity];
      for (let i = start + 2; i < start + 3 * count; i += 3) {
        low = Math.min(low, centres[i]);
        high = Math.max(high, centres[i]);
      }
      height = Math.max(height, high - low);
    }
    return height;
  }

  // Show the person alone, from the front, the left side, above, or obliquely.
  look(name) {
    const { centres, orbit } = this;
    const { across, count } = this.data.body;
    let forward = -0.5 * Math.PI;
    if (across) {
      const [left, right] = across.map((joint) => centres.subarray(3 * joint, 3 * joint + 3));
      forward = Math.atan2(right[0] - left[0], left[1] - right[1]);
    }
    let [low, high] = [Infinity, -Infinity];
    for (let joint = 0; joint < count; joint++) {
      low = Math.min(low, centres[3 * joint + 2]);
      high = Math.max(high, centres[3 * joint + 2]);
    }
    const height = Math.max(this.personHeight(), 0.5 * this.unit);
    const wide = Math.max(1, 0.8 / this.camera.aspect);
    const distance = (PERSON_MARGIN * 0.5 * height * wide) / Math.tan((0.5 * this.camera.fov * Math.PI) / 180);
    const turned = { front: 0, side: 0.5 * Math.PI, top: 0, person: 0.6 }[name];
    const raised = { front: 0.08, side: 0.08, top: 1.5, person: 0.2 }[name];
    this.centre = 0.5 * (low + high) - centres[2];
    this.show("follow", true);
    orbit.look([centres[0], centres[1], centres[2] + this.centre], distance, forward + turned, raised);
  }

  go(time) {
    const { data } = this;
    this.moveFrusta(time);
    if (data.body) this.pose(time);
    if (this.follow) {
      const path = data.paths[0];
      const i = path ? poseAt(path, time) : -1;
      if (data.body) this.orbit.target = [this.centres[0], this.centres[1], this.centres[2] + (this.centre ?? 0)];
      else if (i >= 0) this.orbit.target = [...path.centre.subarray(3 * i, 3 * i + 3)];
    }
    this.dirty = true;
  }

  pose(time) {
    const { three, data, centres } = this;
    const tick = bodyAt(data.body, time, centres);
    const [up, along, start, matrix] = [new three.Vector3(0, 1, 0), new three.Vector3(), new three.Vector3(), new three.Matrix4()];
    const [turn, size] = [new three.Quaternion(), new three.Vector3()];
    const { meshes } = this;
    this.bones.forEach(([parent, child], index) => {
      start.fromArray(centres, 3 * parent);
      along.fromArray(centres, 3 * child).sub(start);
      const length = Math.max(along.length(), 1e-6);
      turn.setFromUnitVectors(up, along.divideScalar(length));
      const thick = meshes.boneIsSolved[index] ? 1 : 0.5;
      meshes.boneMesh.setMatrixAt(index, matrix.compose(start, turn, size.set(thick, length, thick)));
    });
    meshes.balls.forEach((joint, index) => {
      start.fromArray(centres, 3 * joint);
      size.setScalar(meshes.ballIsSolved[index] ? 1 : 0.5);
      meshes.ballMesh.setMatrixAt(index, matrix.compose(start, turn.identity(), size));
    });
    meshes.boneMesh.instanceMatrix.needsUpdate = meshes.ballMesh.instanceMatrix.needsUpdate = true;
    if (!this.sigmaMesh) return;
    const count = data.body.joints.length;
    for (let joint = 0; joint < count; joint++) {
      const radius = data.body.sigma[tick * count + joint];
      start.fromArray(centres, 3 * joint);
      size.setScalar(Number.isFinite(radius) ? Math.max(radius, 1e-6) : 1e-6);
      this.sigmaMesh.setMatrixAt(joint, matrix.compose(start, turn.identity(), size));
    }
    this.sigmaMesh.instanceMatrix.needsUpdate = true;
  }

  // The points are in random order, so the first of them are a thinner cloud of the same shape.
  render(now, moving) {
    const since = now - this.drawn;
    if (moving && since < 2 * STILL_MS) {
      if (since > SLOW_MS) this.share = Math.max(0.2, this.share * 0.85);
      else if (since < FAST_MS) this.share = Math.min(1, this.share * 1.08);
    }
    const count = this.data.points.length / 3;
    this.thin = moving && this.adapts && this.share < 1;
    const drawn = this.thin ? Math.ceil(count * this.share) : count;
    if (this.cloud) this.cloud.setDrawRange(0, drawn);
    this.drawn = now;
    this.dirty = false;
    const { camera, orbit } = this;
    camera.position.set(...orbit.eye());
    camera.lookAt(...orbit.target);
    camera.near = orbit.distance / 200;
    camera.far = orbit.distance + 40 * orbit.radius;
    camera.updateProjectionMatrix();
    this.renderer.render(this.scene, camera);
    if (this.splat) {
      const clip = this.clip.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
      this.splat.draw(clip.elements, drawn);
    }
  }
}
