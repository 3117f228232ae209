// Plays the clips: sets the place of every joint and the colour of the phase, at any instant.
"use strict";
const INK = "#222222", MARK = "#D55E00", ARROW = "#B3125F", GHOST = 0.35; // GHOST: opacity of the plan beside the simulation
const ROLES = { hip: INK, knee: MARK, ankle: "#9C5480" }; // not the colours of the phases, which lie behind
// the values of a clip: travel of the toes, rise of the CoM, these curves, then angle and torque of every joint
const TRAVEL = 0, RISE = 1, HEIGHT = 2, ANGLES = 3, TORQUES = 6, FORCE = 9, JOINTS = 10;
const columns = JOINTS + 2 * facts.joints.length;
const of = (names, first, step) => names.map(([name, color], k) => ({ name, color, column: first + step * k }));
const curves = (joint) => { // of hip, knee and ankle, or of the joint with this number
  const names = joint < 0 ? Object.entries(ROLES) : [["", MARK]], [angle, torque] = joint < 0 ? [ANGLES, TORQUES] : [JOINTS + 2 * joint, JOINTS + 2 * joint + 1];
  const whose = joint < 0 ? "left" : facts.joints[joint].replaceAll("_", " ");
  return [
    { title: "CoM height", unit: "m", limit: null, lines: of([["", INK]], HEIGHT, 1) },
    { title: `${whose} angle`, unit: "°", limit: null, lines: of(names, angle, 1) },
    { title: joint < 0 ? "torque / limit" : "its torque / limit", unit: "", limit: 1, lines: of(names, torque, 1) },
    { title: "ground force / weight", unit: "", limit: null, lines: of([["", INK]], FORCE, 1) },
  ];
};
const byId = (name) => document.getElementById(name);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const stage = byId("stage"), viewer = new MeshCat.Viewer(byId("pane"));
const fill = viewer.set_3d_pane_size.bind(viewer); // the engine would fill the window
viewer.set_3d_pane_size = () => stage.clientHeight && fill(stage.clientWidth, stage.clientHeight);

// lights and a bright background
const set = (path, properties) => {
  for (const [property, value] of Object.entries(properties)) viewer.handle_command({ type: "set_property", path, property, value });
};
set("/Background", { top_color: [1, 1, 1], bottom_color: [0.9, 0.92, 0.95] });
for (const path of ["/Axes", "/Grid", "/Lights/PointLightNegativeX", "/Lights/PointLightPositiveX"]) set(path, { visible: false });
set("/Lights/AmbientLight/<object>", { intensity: 0.7 });
set("/Lights/FillLight/<object>", { intensity: 0.25 });
set("/Lights/SpotLight", { visible: true });
set("/Lights/SpotLight/<object>", { intensity: 0.38, angle: 0.55, penumbra: 0.6, position: [0.4, -1.6, 6], castShadow: true });
viewer.scene_tree.find(["Lights", "SpotLight", "<object>"]).object.shadow.mapSize.set(2048, 2048);

const { BoxGeometry, BufferGeometry, Color, ConeGeometry, CylinderGeometry, Float32BufferAttribute, Group, LineBasicMaterial,
  LineSegments, Mesh, MeshPhongMaterial, Quaternion, SphereGeometry, Vector3 } = MeshCat.THREE;
const world = viewer.scene_tree.find(["meshcat", "jump"]).object;
const floats = (text) => text && new Float32Array(bytes(text).buffer);
const clips = facts.clips.map((clip) => ({
  ...clip,
  ...Object.fromEntries(["poses", "path", "forces", "values"].map((name) => [name, floats(clip[name])])),
  aside: 0,
  duration: (clip.frames - 1) / facts.fps,
}));
let duration = 0, now = 0, playing = false, before = 0, undrawn = 0, lead = clips[0], plots = [];

const point = (poses, k) => new Vector3().fromArray(poses, k);
const turn = (poses, k) => new Quaternion().fromArray(poses, k + 3);

const phaseAt = (clip, time, column = 1) => clip.phases.filter(([start]) => start <= time + 1e-9).at(-1)[column];

// The frames before and after an instant, and the share of the way between them.
function frames(clip, time) {
  const at = Math.min(time, clip.duration) * facts.fps, low = Math.min(Math.floor(at + 1e-9), clip.frames - 1);
  return [low, Math.min(low + 1, clip.frames - 1), Math.max(0, at - low)];
}
function value(clip, column, time) {
  const [low, high, u] = frames(clip, time), at = (k) => clip.values[columns * k + column];
  return at(low) + u * (at(high) - at(low));
}
function base(clip, time) { // and how far the clip is moved aside
  const [low, high, u] = frames(clip, time), width = 7 * clip.bodies;
  return point(clip.poses, width * low).lerp(point(clip.poses, width * high), u).add(new Vector3(0, clip.aside, 0));
}

// what stands still: the ground with its grids, and lines across where the toes should be
const dull = (settings) => new MeshPhongMaterial({ shininess: 12, specular: 0x222222, ...settings }); // so that a colour itself is seen
const add = (parent, child, place, turned) => {
  child.position.fromArray(place);
  if (turned) child.quaternion.fromArray(turned);
  child.castShadow = child.receiveShadow = true;
  parent.add(child);
  return child;
};
const shape = (points, triangles) => {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
  if (triangles) geometry.setIndex([...triangles]).computeVertexNormals();
  return geometry;
};
function grid(box, step, lift, color) { // at whole multiples of the step
  const [w, d, h] = box.size, z = h / 2 + lift, points = [], first = Math.ceil((box.middle[0] - w / 2) / step) * step;
  for (let x = first - box.middle[0]; x <= w / 2; x += step) points.push(x, -d / 2, z, x, d / 2, z);
  for (let y = -Math.floor(d / 2 / step) * step; y <= d / 2; y += step) points.push(-w / 2, y, z, w / 2, y, z);
  return new LineSegments(shape(points), new LineBasicMaterial({ color }));
}
for (const box of facts.ground) {
  const block = add(world, new Mesh(new BoxGeometry(...box.size), dull({ color: "#F4F5F7" })), box.middle, box.turn);
  if (box.size[1] > facts.view.width - 1e-6) block.add(grid(box, 0.1, 0.0015, "#DDE1E7"), grid(box, 0.5, 0.002, "#AEB6C2"));
}
for (const [x, y, z] of facts.marks)
  add(world, new Mesh(new BoxGeometry(0.012, facts.view.width, 0.003), dull({ color: MARK })), [x, y, z + 0.0025]);

// the robots, a group for each joint, and beads along the paths of their CoM
const parts = facts.parts.map((part) => ({ ...part, shape: shape(floats(part.points), floats(part.triangles)) }));
for (const clip of clips) {
  clip.group = add(world, new Group(), [0, 0, 0]);
  clip.paints = Object.fromEntries(["trunk", "limb", "rest"].map((kind) => [kind, dull({ flatShading: parts.some((p) => p.faceted) })]));
  clip.joints = Array.from({ length: clip.bodies }, () => add(clip.group, new Group(), [0, 0, 0]));
  for (const { joint, kind, shape } of parts) add(clip.joints[joint], new Mesh(shape, clip.paints[kind]), [0, 0, 0]);
  const bead = new SphereGeometry(0.007, 12, 8), landing = clip.phases.filter(([, phase]) => phase === "landing").at(-1); // of a chain the last one
  let last = new Vector3(Infinity, 0, 0);
  for (let k = 0; k < clip.frames && k / facts.fps < (landing ? landing[0] + 0.6 : Infinity); k++) { // later it hardly moves
    const place = point(clip.path, 3 * k);
    if (place.distanceTo(last) < 0.025) continue;
    add(clip.group, new Mesh(bead, dull({ color: facts.css[phaseAt(clip, k / facts.fps)] })), place.toArray());
    last = place;
  }
}

function pose(clip, time) {
  const [low, high, u] = frames(clip, time), width = 7 * clip.bodies;
  clip.joints.forEach((joint, j) => {
    const [a, b] = [low, high].map((frame) => width * frame + 7 * j);
    joint.position.lerpVectors(point(clip.poses, a), point(clip.poses, b), u);
    joint.quaternion.slerpQuaternions(turn(clip.poses, a), turn(clip.poses, b), u);
  });
  press(clip, u < 0.5 ? low : high);
  for (const [kind, paint] of Object.entries(clip.paints)) {
    paint.color.setRGB(...facts.colors[phaseAt(clip, time)][kind]);
    paint.transparent = ghosted(clip);
    paint.opacity = ghosted(clip) ? GHOST : 1;
  }
}

// forces of the ground, and where they act: an arrow for each foot, a dot for both, seen through the legs
const solid = (shape) => new Mesh(shape, new MeshPhongMaterial({ color: ARROW, transparent: true, depthTest: false }));
const ARROW_M = 0.4, HEAD_M = 0.07, LONGEST_M = 1.2; // length for the robot's weight, of the head, and at most
for (const clip of clips.filter(({ forces }) => forces)) {
  clip.arrows = [0, 1].map(() => {
    const [shaft, head, arrow] = [solid(new CylinderGeometry(0.011, 0.011, 1, 12)), solid(new ConeGeometry(0.028, HEAD_M, 16)), new Group()];
    return arrow.add(shaft, head);
  });
  clip.dot = solid(new CylinderGeometry(0.035, 0.035, 0.008, 24).rotateX(Math.PI / 2));
  clip.group.add(...clip.arrows, clip.dot);
}
function press(clip, frame) {
  if (!clip.forces) return;
  const middle = new Vector3(), up = new Vector3(0, 1, 0);
  let total = 0;
  for (const [foot, arrow] of clip.arrows.entries()) {
    const [x, y, z, ...force] = clip.forces.subarray(12 * frame + 6 * foot, 12 * frame + 6 * foot + 6);
    arrow.visible = !isNaN(z);
    if (!arrow.visible) continue;
    const way = new Vector3(...force), size = way.length(), length = Math.min(LONGEST_M, (ARROW_M * size) / facts.weight);
    const [shaft, head] = arrow.children;
    arrow.position.set(x, y, z);
    arrow.quaternion.setFromUnitVectors(up, way.normalize());
    shaft.scale.y = Math.max(0.001, length - HEAD_M);
    shaft.position.y = shaft.scale.y / 2;
    head.position.y = Math.max(HEAD_M, length) - HEAD_M / 2;
    middle.add(new Vector3(x, y, z + 0.008).multiplyScalar(force[2]));
    total += force[2];
  }
  clip.dot.visible = total > 0;
  if (total > 0) clip.dot.position.copy(middle.divideScalar(total));
  for (const mesh of [clip.dot, ...clip.arrows.flatMap(({ children }) => children)]) mesh.material.opacity = ghosted(clip) ? 0.5 : 1;
}

function seek(time) {
  now = Math.max(0, Math.min(duration, time));
  for (const clip of clips) if (shown(clip)) pose(clip, now);
  byId("time").value = now;
  const phase = phaseAt(lead, now);
  byId("phase-name").textContent = phaseAt(lead, now, 2);
  byId("dot").style.background = facts.css[phase];
  byId("clock").textContent = `${now.toFixed(2)} s`;
  compare();
  for (const plot of plots) plot.point();
  if (following) go_along();
  viewer.set_dirty();
}

const said = (x, digits) => x.toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", "−"); // never "−0.0"

// plan and simulation in figures, as long as both last
const ROWS = [["travel of the toes", TRAVEL], ["CoM over take-off", RISE]];
function compare() {
  const [simulation, plan] = ["simulation", "plan"].map((name) => clips.find((clip) => clip.name === name));
  if (!simulation || !plan) return;
  const end = Math.min(simulation.duration, plan.duration), at = Math.min(now, end);
  const away = base(simulation, at).sub(base(plan, at)), mm = (x) => `${said(1000 * x, 1)} mm`;
  away.y += plan.aside - simulation.aside;
  const rows = ROWS.map(([name, column]) => {
    const [a, b] = [simulation, plan].map((clip) => value(clip, column, at));
    return [name, `${said(a, 3)} m`, `${said(b, 3)} m`, mm(a - b)];
  });
  const last = ["base, apart", `x ${mm(away.x)}`, `z ${mm(away.z)}`, mm(away.length())];
  const table = [[now > end ? `at ${end.toFixed(2)} s, the plan's end` : "now", "simulation", "plan", "apart"], ...rows, last];
  table.forEach((row, i) => row.forEach((text, k) => { byId("apart").rows[i].cells[k].textContent = text; }));
}
if (clips.length > 1)
  for (let i = 0; i < 4; i++) {
    const row = byId("apart").insertRow();
    for (let k = 0; k < 4; k++) row.append(document.createElement(i && k ? "td" : "th"));
  }

// what is shown
const shown = (clip) => byId("show").value === "both" || byId("show").value === clip.name;
const ghosted = (clip) => clip.name === "plan" && byId("show").value === "both";
function choose() {
  lead = clips.find(shown);
  duration = Math.max(...clips.filter(shown).map((clip) => clip.duration));
  byId("time").max = duration;
  for (const clip of clips) clip.group.visible = shown(clip);
  const stops = lead.phases.flatMap(([start, phase], i) => {
    const end = i + 1 < lead.phases.length ? lead.phases[i + 1][0] : lead.duration;
    return [`${facts.css[phase]} ${(100 * start) / duration}% ${(100 * end) / duration}%`];
  });
  byId("time").style.backgroundImage = `linear-gradient(to right, ${stops.join(", ")}, #dde1e7 0)`;
  const gap = byId("show").value === "both" ? Number(byId("offset").value) : 0;
  byId("offset-m").textContent = `${gap} m`;
  for (const clip of clips) {
    clip.aside = gap * (clip.name === "plan" ? 0.5 : -0.5);
    clip.group.position.y = clip.aside;
  }
  for (const plot of plots) plot.draw();
  seek(now);
}

// curves, with the phases behind them
const plot_of = (curve) => {
  const [card, title, plot, canvas, cursor] = ["div", "h2", "div", "canvas", "div"].map((tag) => document.createElement(tag));
  title.append(curve.title + (curve.unit && ` [${curve.unit}]`));
  const numbers = curve.lines.map(({ name, color, column }) => {
    const number = document.createElement("b");
    number.style.color = color;
    title.append(number, " "); // so that a line can break between them
    return { name, number, column, digits: curve.unit === "°" ? 0 : 2 };
  });
  plot.className = "plot";
  cursor.className = "cursor";
  plot.append(canvas, cursor);
  card.append(title, plot);
  byId("curves").append(card);
  const used = new Set(numbers.map(({ column }) => column));
  const seen = clips.flatMap((clip) => [...clip.values].filter((_, k) => used.has(k % columns)));
  const finite = seen.filter(isFinite).sort((a, b) => a - b);
  if (!finite.length) card.style.display = "none";
  let [low, high] = [finite[0], finite.at(-1)];
  if (curve.limit) [low, high] = [0, Math.max(high, 1.05 * curve.limit)];
  [low, high] = [low - 0.04 * (high - low), high + 0.04 * (high - low) + 1e-6];
  const here = (e) => {
    const box = plot.getBoundingClientRect();
    play(false);
    seek((duration * (e.clientX - box.left)) / box.width);
  };
  plot.addEventListener("pointerdown", (e) => { plot.setPointerCapture(e.pointerId); here(e); });
  plot.addEventListener("pointermove", (e) => { if (e.buttons) here(e); });
  function draw() {
    const [w, h] = [plot.clientWidth, plot.clientHeight], pen = canvas.getContext("2d");
    canvas.width = w * devicePixelRatio;
    canvas.height = h * devicePixelRatio;
    pen.scale(devicePixelRatio, devicePixelRatio);
    const x = (t) => (w * t) / duration, y = (value) => h - (h * (value - low)) / (high - low);
    lead.phases.forEach(([start, phase], k) => {
      const end = k + 1 < lead.phases.length ? lead.phases[k + 1][0] : lead.duration;
      pen.fillStyle = facts.css[phase] + "22";
      pen.fillRect(x(start), 0, x(end) - x(start), h);
    });
    const line = (points) => { pen.beginPath(); points.forEach(([a, b], k) => (k ? pen.lineTo(a, b) : pen.moveTo(a, b))); pen.stroke(); };
    pen.strokeStyle = "#999";
    for (const level of [0, curve.limit]) if (level !== null && low < level && level < high) line([[0, y(level)], [w, y(level)]]);
    for (const clip of clips.filter(shown)) {
      pen.setLineDash(ghosted(clip) ? [4, 3] : []);
      pen.lineWidth = 1.5;
      curve.lines.forEach(({ color, column }) => {
        pen.strokeStyle = color;
        line(Array.from({ length: clip.frames }, (_, k) => [x(k / facts.fps), y(clip.values[columns * k + column])]));
      });
    }
  }
  function point() {
    cursor.style.left = `${(100 * now) / duration}%`;
    for (const { name, number, column, digits } of numbers)
      number.textContent = `${name} ${said(value(lead, column, now), digits)}`;
  }
  return { draw, point };
};
function plot() {
  byId("curves").replaceChildren();
  plots = curves(Number(byId("joint").value)).map(plot_of);
  for (const one of plots) { one.draw(); one.point(); }
}

// the camera: the whole jump, whatever the shape of the window
const middle = [(facts.view.x[0] + facts.view.x[1]) / 2, (facts.view.z[0] + facts.view.z[1]) / 2, 0]; // y points up
const size = [facts.view.x[1] - facts.view.x[0], facts.view.z[1] - facts.view.z[0], facts.view.width];
const opening = (24 * Math.PI) / 180;
let following = false, eye = null; // where the camera's middle is, as it follows
const upright = ({ x, y, z }) => new Vector3(x, z, -y); // the engine's y points up
function look() {
  const [w, h] = [stage.clientWidth, stage.clientHeight];
  if (!w || !h) return; // a frame that is not on the page yet
  const free = Math.max(0.3, 1 - 50 / h); // below the title
  const [yaw, pitch] = { side: [0, 0.1], corner: [-0.75, 0.3], front: [Math.PI / 2, 0.15] }[byId("view").value];
  const [c, s] = [Math.abs(Math.cos(yaw)), Math.abs(Math.sin(yaw))];
  const long = following ? Math.min(1.5, size[0]) : size[0], across = following ? 1 : size[2];
  const wide = long * c + across * s, deep = long * s + across * c; // of the box around the jump, as seen
  const tall = size[1] * Math.cos(pitch) + deep * Math.sin(pitch);
  const far = Math.max(tall / free, (wide / w) * h) / 2 / Math.tan(opening / 2) + deep / 2;
  const offset = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
  eye = following ? upright(base(lead, now)).setY(middle[1]) : new Vector3(...middle);
  const raised = (tall / free - tall) / 2.6; // what is free is the lower part
  const place = eye.toArray().map((x, i) => x + far * offset[i] + (i === 1 ? raised : 0));
  viewer.camera.fov = (opening * 180) / Math.PI;
  viewer.camera.near = 0.1;
  set("/Cameras/default/rotated/<object>", { position: place });
  viewer.controls.target.set(...eye.toArray().map((x, i) => x + (i === 1 ? raised : 0)));
  viewer.controls.update();
}
function go_along() {
  const next = upright(base(lead, now)).setY(eye.y), way = next.clone().sub(eye);
  eye = next;
  viewer.camera.position.add(way);
  viewer.controls.target.add(way);
  viewer.controls.update();
}
function follow(yes) {
  following = yes;
  byId("follow").setAttribute("aria-pressed", yes);
  look();
}

// numbers along the ground, drawn by the browser where the camera sees them
const labels = facts.ruler.map(({ at, text }) => {
  const span = document.createElement("span");
  span.textContent = text;
  byId("labels").append(span);
  return { at, span };
});
// the names of plan and simulation above their heads, where they stand apart
const names = clips.length < 2 ? [] : clips.map((clip) => {
  const span = document.createElement("span");
  span.textContent = clip.name;
  byId("labels").append(span);
  return { clip, span };
});
function place_labels() {
  viewer.camera.updateMatrixWorld();
  const above = names.map(({ clip, span }) => ({ at: base(clip, now).add(new Vector3(0, 0, 0.5)).toArray(), span, apart: clip.aside }));
  for (const { at, span, apart = true } of [...labels, ...above]) {
    const p = upright(new Vector3(...at)).project(viewer.camera);
    span.style.display = p.z < 1 && apart ? "" : "none"; // not behind the camera
    span.style.left = `${((p.x + 1) / 2) * stage.clientWidth}px`;
    span.style.top = `${((1 - p.y) / 2) * stage.clientHeight}px`;
  }
}

const pressed = (name) => byId(name).getAttribute("aria-pressed") === "true";
function play(yes) {
  if (yes && now >= duration) now = 0;
  playing = yes;
  undrawn = 2; // the clock starts when the first frames are drawn, which may take a second
  byId("play").textContent = yes ? "❚❚" : "▶";
}

const step = (frames) => { play(false); seek((Math.round(now * facts.fps) + frames) / facts.fps); };
function tick(instant) {
  if (playing && undrawn > 0) {
    undrawn -= 1;
    before = instant;
  } else if (playing) {
    seek(now + (Math.max(0, instant - before) / 1000) * Number(byId("speed").value));
    before = instant;
    if (now >= duration && pressed("loop")) now = 0;
    else if (now >= duration) play(false);
  }
  place_labels();
  requestAnimationFrame(tick);
}

byId("title").textContent = facts.title;
byId("note").textContent = `${clips.map((clip) => clip.name).join(" and ")} · ${facts.note} · drag to turn, wheel to zoom`;
byId("time").addEventListener("input", (e) => { play(false); seek(Number(e.target.value)); });
byId("play").addEventListener("click", () => play(!playing));
byId("back").addEventListener("click", () => step(-1));
byId("on").addEventListener("click", () => step(1));
byId("joint").append(new Option("hip, knee, ankle", -1), ...facts.joints.map((name, k) => new Option(name.replaceAll("_", " "), k)));
byId("joint").addEventListener("change", plot);
for (const [name, color] of [...Object.entries(facts.css).filter(([name]) => clips.some((clip) => clip.phases.some(([, phase]) => phase === name))), ["force of the ground, CoP", ARROW]]) {
  if (color === ARROW && clips.every(({ forces }) => !forces)) continue;
  const [entry, dot] = [document.createElement("span"), document.createElement("i")];
  dot.style.background = color;
  entry.append(dot, name);
  byId("legend").append(entry);
}
if (clips.length > 1) byId("legend").append("pale, dashed: the plan beside the simulation");
byId("view").addEventListener("change", look);
byId("loop").addEventListener("click", () => byId("loop").setAttribute("aria-pressed", !pressed("loop")));
byId("follow").addEventListener("click", () => follow(!following));
byId("offset").addEventListener("input", () => { byId("show").value = "both"; choose(); });
for (const name of [...clips.map((clip) => clip.name), ...(clips.length > 1 ? ["both"] : [])])
  byId("show").append(new Option(name, name));
byId("show").addEventListener("change", choose);
if (clips.length < 2) for (const name of ["show", "beside"]) byId(name).style.display = "none";
const KEYS = { Space: () => play(!playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => { play(false); seek(0); }, End: () => { play(false); seek(duration); } };
addEventListener("keydown", (e) => {
  if (!KEYS[e.code] || /^(INPUT|SELECT)$/.test(e.target.tagName) || (e.code === "Space" && e.target !== document.body)) return;
  e.preventDefault();
  KEYS[e.code]();
});
addEventListener("resize", () => { viewer.set_3d_pane_size(); look(); for (const plot of plots) plot.draw(); });

// jump.html#t=0.95&view=corner&show=both opens paused, at that instant; &follow=1 with the robot in the middle
const asked = new URLSearchParams(location.hash.slice(1));
for (const name of ["view", "show"])
  if ([...byId(name).options].some((o) => o.value === asked.get(name))) byId(name).value = asked.get(name);
viewer.set_3d_pane_size();
choose();
plot();
seek(Number(asked.get("t")) || 0);
follow(asked.has("follow") ? asked.get("follow") === "1" : stage.clientWidth < 0.9 * stage.clientHeight); // as on a phone
if (!asked.has("t")) // it starts when it is seen: in a notebook, it may be far below
  new IntersectionObserver((entries, watch) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    play(true);
  }).observe(stage);
requestAnimationFrame(tick);
