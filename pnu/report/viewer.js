// The 3D views: one canvas, one camera; clouds and surfaces of one shape alone or side by side.
"use strict";

const $ = (selector, root = document) => root.querySelector(selector);
const RANGE = 1.25; // positions are stored as 0..65535 over -RANGE..RANGE, in units of the true radius
const MODES = { normals: 0, errors: 1, plain: 2, colors: 3, found: 4 };
const TURN = { x: [0, 0, Math.PI / 2], y: [0, 0, 0], z: [-Math.PI / 2, 0, 0] }; // brings the axis that points up to y

const VERTEX = `#version 300 es
in vec3 position;
in vec3 normal;
in float error;
in vec3 stored;
in float found;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform mat3 normalMatrix;
uniform vec4 uCell; // scale and shift of the picture's part that this drawing has
uniform float uPixels, uRadius;
out vec3 vNormal, vView, vObject, vStored;
out float vError, vFound;
void main() {
  vec4 view = modelViewMatrix * vec4((position * 2.0 - 1.0) * ${RANGE}, 1.0);
  vNormal = normalMatrix * normal;
  vObject = normal;
  vView = view.xyz;
  vError = error;
  vStored = stored;
  vFound = found;
  gl_Position = projectionMatrix * view;
  gl_PointSize = max(uRadius * uPixels * projectionMatrix[1][1] / gl_Position.w, 2.0);
  gl_Position.xy = gl_Position.xy * uCell.xy + uCell.zw * gl_Position.w;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 vNormal, vView, vObject, vStored;
in float vError, vFound;
uniform int uMode, uMesh;
uniform vec3 uColors[16];
out vec4 color;
vec3 errorColor(float t) {
  float x = clamp(t, 0.0, 1.0) * 15.0;
  int i = min(int(x), 14);
  return mix(uColors[i], uColors[i + 1], x - float(i));
}
void main() {
  vec3 n = dot(vNormal, vNormal) > 0.0 ? normalize(vNormal) : vec3(0.0, 0.0, 1.0);
  bool inside = false, away = false;
  if (uMesh == 1) {
    inside = dot(n, vView) > 0.0 && !gl_FrontFacing;
    if (dot(n, vView) > 0.0) n = -n;
  } else {
    vec2 d = gl_PointCoord * 2.0 - 1.0;
    if (dot(d, d) > 1.0) discard;
    away = n.z < -0.05;
    if (n.z < 0.0) n = -n;
    n = normalize(n + 0.5 * vec3(d.x, -d.y, sqrt(1.0 - dot(d, d))));
  }
  vec3 base = uMesh == 1 ? (inside ? vec3(0.66, 0.46, 0.35) : vec3(0.73, 0.75, 0.78)) : vec3(0.23, 0.28, 0.37);
  if (uMode == 0) base = pow(normalize(vObject) * 0.5 + 0.5, vec3(2.2));
  if (uMode == 1) base = pow(errorColor(vError), vec3(2.2));
  if (uMode == 3) base = pow(vStored, vec3(2.2));
  if (uMode == 4) {
    base = vec3(0.5, 0.53, 0.57);
    if (vFound > 0.5) base = vec3(0.8, 0.03, 0.02); // stray
    if (vFound > 1.5) base = vec3(0.95, 0.42, 0.0); // its normal contradicts its neighbors'
    if (vFound > 2.5) base = vec3(0.02, 0.22, 0.75); // on the rim of a hole
  }
  float light = 0.75 * max(dot(n, normalize(vec3(-0.55, 0.6, 0.58))), 0.0)
              + 0.15 * max(dot(n, normalize(vec3(0.9, 0.05, 0.43))), 0.0) + 0.12 + 0.14 * (0.5 + 0.5 * n.y) + 0.1 * n.z;
  float gloss = 0.07 * pow(max(dot(n, normalize(vec3(-0.3, 0.33, 0.9))), 0.0), 24.0);
  color = vec4(pow(base * light + gloss, vec3(1.0 / 2.2)), 1.0);
  if (away && uMode != 4) color.rgb = mix(color.rgb, vec3(1.0), 0.8); // the far side, or a normal that looks inward: pale
}`;

async function unpack(view) {
  if (view.url) return (await fetch(view.url)).arrayBuffer();
  const bytes = Uint8Array.from(atob(view.data), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

class Viewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new OGL.Renderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.gl = this.renderer.gl;
    this.gl.clearColor(1, 1, 1, 1);
    this.camera = new OGL.Camera(this.gl, { fov: 30, near: 0.05, far: 60 });
    this.home();
    this.orbit = new OGL.Orbit(this.camera, { element: canvas, ease: 1, inertia: 0 });
    this.program = new OGL.Program(this.gl, {
      vertex: VERTEX, fragment: FRAGMENT, cullFace: false,
      uniforms: {
        uCell: { value: [1, 1, 0, 0] }, uPixels: { value: 1 }, uRadius: { value: 0.01 }, uMode: { value: 0 },
        uMesh: { value: 0 }, uColors: { value: new Array(48).fill(0) },
      },
    });
    this.loaded = new WeakMap();
    this.last = "";
    const frame = () => { this.frame(); requestAnimationFrame(frame); };
    requestAnimationFrame(frame);
  }

  home() {
    const [a, e, far] = [Math.PI / 6, Math.PI / 12, 4.1];
    this.camera.position.set(far * Math.cos(e) * Math.sin(a), far * Math.sin(e), far * Math.cos(e) * Math.cos(a));
    this.camera.lookAt([0, 0, 0]);
    if (this.orbit) { this.orbit.target.set(0, 0, 0); this.orbit.forcePosition(); }
  }

  async load(view) {
    if (!this.loaded.has(view)) this.loaded.set(view, unpack(view).then((buffer) => this.build(view, buffer)));
    return this.loaded.get(view);
  }

  build(view, buffer) {
    const geometry = (part) => {
      if (!part) return null;
      const array = (type, [start, length]) => new type(buffer, start, length);
      const attributes = {
        position: { size: 3, data: array(Uint16Array, part.position), type: this.gl.UNSIGNED_SHORT, normalized: true },
        normal: { size: 3, data: part.normal ? array(Int8Array, part.normal) : new Int8Array(part.position[1]), type: this.gl.BYTE, normalized: true },
        error: { size: 1, data: part.error ? array(Uint8Array, part.error) : new Uint8Array(part.position[1] / 3), type: this.gl.UNSIGNED_BYTE, normalized: true },
        stored: { size: 3, data: part.stored ? array(Uint8Array, part.stored) : new Uint8Array(part.position[1]), type: this.gl.UNSIGNED_BYTE, normalized: true },
        found: { size: 1, data: part.found ? array(Uint8Array, part.found) : new Uint8Array(part.position[1] / 3), type: this.gl.UNSIGNED_BYTE },
      };
      if (part.index) { // stored as differences
        let sum = 0;
        attributes.index = { data: Uint32Array.from(array(Int32Array, part.index), (step) => (sum += step)) };
      }
      const made = new OGL.Geometry(this.gl, attributes);
      const mesh = new OGL.Mesh(this.gl, {
        geometry: made, program: this.program, mode: part.index ? this.gl.TRIANGLES : this.gl.POINTS, frustumCulled: false,
      });
      return Object.assign(mesh, { isSurface: !!part.index, spacing: part.spacing || 0, can: { normals: !!part.normal, errors: !!part.error, plain: true, colors: !!part.stored, found: !!part.found } });
    };
    return view.items.map((item) => ({ name: item.name, points: geometry(item.cloud), surface: geometry(item.surface) }));
  }

  async forget(view) {
    const items = (await this.loaded.get(view)) || [];
    this.loaded.delete(view);
    for (const item of items) for (const drawing of [item.points, item.surface]) if (drawing) drawing.geometry.remove();
  }

  show(state) { this.state = state; this.last = ""; this.frame(); }

  frame() {
    if (!this.state) return;
    const { width, height } = this.canvas.parentElement.getBoundingClientRect();
    this.orbit.update();
    const key = [width, height, ...this.camera.position, ...this.orbit.target].join();
    if (key === this.last || !width) return;
    this.last = key;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.renderer.dpr = ratio;
    this.renderer.setSize(width, height);
    const { drawings, columns, mode, colors, up } = this.state;
    const rows = Math.ceil(drawings.length / columns);
    const aspect = width / columns / (height / rows);
    this.camera.perspective({ aspect, fov: (360 / Math.PI) * Math.atan(Math.tan(Math.PI / 12) / Math.min(aspect, 1)) });
    const gl = this.gl, u = this.program.uniforms;
    gl.disable(gl.SCISSOR_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    drawings.forEach((drawing, i) => {
      const [column, row] = [i % columns, Math.floor(i / columns)];
      const [w, h] = [this.canvas.width / columns, this.canvas.height / rows];
      gl.scissor(column * w, this.canvas.height - (row + 1) * h, w, h);
      u.uCell.value = [1 / columns, 1 / rows, (2 * column + 1) / columns - 1, 1 - (2 * row + 1) / rows];
      u.uPixels.value = h;
      u.uRadius.value = 0.42 * drawing.spacing;
      drawing.rotation.set(...TURN[up]);
      u.uMode.value = MODES[drawing.can[mode] ? mode : drawing.can.found ? "found" : "plain"];
      u.uMesh.value = drawing.isSurface ? 1 : 0;
      u.uColors.value = colors;
      for (const hidden of drawing.isSurface ? [gl.BACK, gl.FRONT] : [null]) { // where a fold has two faces at one depth, show the front
        this.program.cullFace = hidden;
        this.renderer.render({ scene: drawing, camera: this.camera, clear: false });
      }
    });
    this.canvas.dataset.drawn = String(Number(this.canvas.dataset.drawn || 0) + 1);
  }
}

// The buttons of a page and the drawings that they choose.
class Gallery {
  constructor(colors) {
    this.colors = colors;
    this.viewer = new Viewer($("#canvas"));
    this.pick = { shape: null, kind: null, item: null, form: "points", mode: null, grid: true, up: "y" };
    this.views = [];
    $("#grid").onclick = () => { this.pick.grid = true; this.refresh(); };
    $("#home").onclick = () => { this.viewer.home(); this.viewer.last = ""; };
    document.addEventListener("keydown", (event) => {
      if (event.target.closest("input, select, textarea")) return;
      const button = $("#items").children[Number(event.key) - 1];
      if (button && !event.ctrlKey && !event.metaKey && !event.altKey) button.click();
    });
  }

  open(views) {
    const before = this.views;
    this.views = views;
    const pick = this.pick, first = views[0];
    for (const key of ["shape", "kind"]) if (!views.some((view) => view[key] === pick[key])) pick[key] = first[key];
    return this.refresh().then(() => before.forEach((view) => this.viewer.forget(view)));
  }

  buttons(id, values, key, names = {}) {
    $(id).replaceChildren(...values.map((value) => {
      const button = document.createElement("button");
      button.textContent = names[value] || value;
      button.dataset.value = value;
      button.setAttribute("aria-pressed", String(this.pick[key] === value));
      button.onclick = () => { this.pick[key] = value; if (key === "item") this.pick.grid = false; this.refresh(); };
      return button;
    }));
    $(id).parentElement.hidden = values.length < 2 && key !== "item";
  }

  async refresh() {
    const { pick, views, viewer } = this, unique = (key) => [...new Set(views.map((view) => view[key]))];
    let view = views.find((v) => v.shape === pick.shape && v.kind === pick.kind);
    if (!view) { view = views.find((v) => v.shape === pick.shape) || views[0]; [pick.shape, pick.kind] = [view.shape, view.kind]; }
    const items = await viewer.load(view);
    if (!this.views.includes(view)) return; // others came meanwhile
    const forms = items.some((item) => item.surface && item.points) ? ["points", "surfaces"] : ["points"];
    if (!forms.includes(pick.form)) pick.form = "points";
    if (!items.some((item) => item.name === pick.item)) pick.item = items[0].name;
    const drawing = (item) => (pick.form === "surfaces" ? item.surface : item.points || item.surface) || null;
    const all = items.map(drawing).filter(Boolean);
    const modes = Object.keys(MODES).filter((mode) => all.some((one) => one.can[mode]));
    if (!modes.includes(pick.mode)) pick.mode = ["found", "normals", "colors", "plain"].find((mode) => modes.includes(mode));
    const shown = (pick.grid ? items : items.filter((item) => item.name === pick.item)).filter(drawing);
    this.buttons("#shapes", unique("shape"), "shape");
    this.buttons("#kinds", unique("kind"), "kind");
    this.buttons("#items", items.filter(drawing).map((item) => item.name), "item");
    this.buttons("#forms", forms, "form");
    this.buttons("#modes", modes, "mode", { errors: view.error, found: "what was found" });
    this.buttons("#ups", ["x", "y", "z"], "up");
    $("#ups").parentElement.hidden = false;
    for (const button of $("#items").children) button.setAttribute("aria-pressed", String(!pick.grid && pick.item === button.dataset.value));
    $("#grid").setAttribute("aria-pressed", String(pick.grid));
    const box = viewer.canvas.parentElement.getBoundingClientRect(), count = shown.length || 1;
    const cell = (c) => Math.min(box.width / c, box.height / Math.ceil(count / c)) * (count % c ? 0.8 : 1); // no empty places
    const columns = Array.from({ length: count }, (_, i) => i + 1).reduce((a, b) => (cell(b) > cell(a) ? b : a));
    $("#labels").style.gridTemplateColumns = `repeat(${columns}, 1fr)`;
    $("#labels").replaceChildren(...shown.map((item) => Object.assign(document.createElement("span"), { textContent: item.name })));
    $("#bar").hidden = pick.mode !== "errors";
    $("#bar-what").textContent = view.bar;
    $("#bar-end").textContent = view.limit;
    viewer.show({ drawings: shown.map(drawing), columns, mode: pick.mode, colors: this.colors, up: pick.up });
  }
}
