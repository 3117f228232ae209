// Plays the clips: sets the place of every joint and the colour of the phase, at any instant.
"use strict";
const byId = (name) => document.getElementById(name);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const viewer = new MeshCat.Viewer(byId("pane"));
for (const text of commands) viewer.handle_command_bytearray(bytes(text));
const tell = (type, path, rest) => viewer.handle_command({ type, path, ...rest });

tell("set_property", "/Lights/SpotLight/<object>", { property: "castShadow", value: true }); // Python's client knows no capitals
viewer.scene_tree.find(["Lights", "SpotLight", "<object>"]).object.shadow.mapSize.set(2048, 2048);

const clips = facts.clips.map((clip) => ({
  ...clip,
  poses: new Float32Array(bytes(clip.poses).buffer),
  duration: (clip.frames - 1) / facts.fps,
  painted: null,
}));
let duration = 0, now = 0, playing = false, before = 0, lead = clips[0];

// Column-major matrix of the pose between two frames; `u` is the share of the way.
const { Matrix4, Quaternion, Vector3 } = MeshCat.THREE;
const point = (poses, k) => new Vector3().fromArray(poses, k);
const turn = (poses, k) => new Quaternion().fromArray(poses, k + 3);
function between(poses, a, b, u) {
  const place = point(poses, a).lerp(point(poses, b), u), attitude = turn(poses, a).slerp(turn(poses, b), u);
  return new Matrix4().compose(place, attitude, new Vector3(1, 1, 1)).toArray();
}

const phaseAt = (clip, time) => clip.phases.filter(([start]) => start <= time + 1e-9).at(-1)[1];

function pose(clip, time) {
  const at = Math.min(time, clip.duration) * facts.fps;
  const low = Math.min(Math.floor(at + 1e-9), clip.frames - 1), high = Math.min(low + 1, clip.frames - 1);
  const width = 7 * clip.bodies;
  for (let j = 0; j < clip.bodies; j++) {
    const matrix = between(clip.poses, low * width + 7 * j, high * width + 7 * j, Math.max(0, at - low));
    tell("set_transform", `/meshcat/jump/${clip.name}/${j + 1}`, { matrix });
  }
  const phase = phaseAt(clip, time), alpha = ghosted(clip) ? facts.ghost : 1;
  if (clip.painted !== phase + alpha) {
    clip.painted = phase + alpha;
    for (const kind of ["trunk", "limb", "rest"])
      for (const path of clip[kind])
        tell("set_property", path, { property: "color", value: [...facts.colors[phase][kind], alpha] });
  }
}

function seek(time) {
  now = Math.max(0, Math.min(duration, time));
  for (const clip of clips) if (shown(clip)) pose(clip, now);
  byId("time").value = now;
  const phase = phaseAt(lead, now);
  byId("phase-name").textContent = phase;
  byId("dot").style.background = facts.css[phase];
  byId("clock").textContent = `${now.toFixed(2)} s`;
}

// what is shown
const shown = (clip) => byId("show").value === "both" || byId("show").value === clip.name;
const ghosted = (clip) => clip.name === "plan" && byId("show").value === "both";
function choose() {
  lead = clips.find(shown);
  duration = Math.max(...clips.filter(shown).map((clip) => clip.duration));
  byId("time").max = duration;
  for (const clip of clips) tell("set_property", `/meshcat/jump/${clip.name}`, { property: "visible", value: shown(clip) });
  const stops = lead.phases.flatMap(([start, phase], i) => {
    const end = i + 1 < lead.phases.length ? lead.phases[i + 1][0] : lead.duration;
    return [`${facts.css[phase]} ${(100 * start) / duration}% ${(100 * end) / duration}%`];
  });
  byId("time").style.background = `linear-gradient(to right, ${stops.join(", ")}, #dde1e7 0)`;
  seek(now);
}

// the camera: the whole jump, whatever the shape of the window
const middle = [(facts.view.x[0] + facts.view.x[1]) / 2, (facts.view.z[0] + facts.view.z[1]) / 2, 0]; // y points up
const size = [facts.view.x[1] - facts.view.x[0], facts.view.z[1] - facts.view.z[0], facts.view.width];
const opening = (24 * Math.PI) / 180;
function look() {
  if (!innerWidth || !innerHeight) return; // a frame that is not on the page yet
  const aspect = innerWidth / innerHeight, free = Math.max(0.3, 1 - 150 / innerHeight); // below the title, above the bar
  const [yaw, pitch] = { side: [0, 0.1], corner: [-0.75, 0.3], front: [Math.PI / 2, 0.15] }[byId("view").value];
  const [c, s] = [Math.abs(Math.cos(yaw)), Math.abs(Math.sin(yaw))];
  const wide = size[0] * c + size[2] * s, deep = size[0] * s + size[2] * c; // of the box around the jump, as seen
  const tall = size[1] * Math.cos(pitch) + deep * Math.sin(pitch);
  const far = Math.max(tall / free, wide / aspect) / 2 / Math.tan(opening / 2) + deep / 2;
  const offset = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
  const place = middle.map((x, i) => x + far * offset[i]);
  viewer.camera.fov = (opening * 180) / Math.PI;
  viewer.camera.near = 0.1;
  tell("set_property", "/Cameras/default/rotated/<object>", { property: "position", value: place });
  viewer.controls.target.set(...middle);
}

// numbers along the ground, drawn by the browser where the camera sees them
const labels = facts.ruler.map(({ at, text }) => {
  const span = document.createElement("span");
  span.textContent = text;
  byId("labels").append(span);
  return { at, span };
});
function place_labels() {
  viewer.camera.updateMatrixWorld();
  for (const { at, span } of labels) {
    const p = new Vector3(at[0], at[2], -at[1]).project(viewer.camera); // the engine's y points up
    span.style.display = p.z < 1 ? "" : "none"; // not behind the camera
    span.style.left = `${((p.x + 1) / 2) * innerWidth}px`;
    span.style.top = `${((1 - p.y) / 2) * innerHeight}px`;
  }
}

function play(yes) {
  if (yes && now >= duration) now = 0;
  playing = yes;
  before = performance.now();
  byId("play").textContent = yes ? "❚❚" : "▶";
}

function tick(instant) {
  if (playing) {
    seek(now + (Math.max(0, instant - before) / 1000) * Number(byId("speed").value));
    before = instant;
    if (now >= duration) play(false);
  }
  place_labels();
  requestAnimationFrame(tick);
}

byId("title").textContent = facts.title;
byId("note").textContent = `${clips.map((clip) => clip.name).join(" and ")} · ${facts.note} · drag to turn, wheel to zoom`;
byId("time").addEventListener("input", (e) => { play(false); seek(Number(e.target.value)); });
byId("play").addEventListener("click", () => play(!playing));
byId("view").addEventListener("change", look);
for (const name of [...clips.map((clip) => clip.name), ...(clips.length > 1 ? ["both"] : [])])
  byId("show").append(new Option(name, name));
byId("show").addEventListener("change", choose);
if (clips.length < 2) byId("show").style.display = "none";
addEventListener("keydown", (e) => { if (e.code === "Space" && e.target === document.body) { e.preventDefault(); play(!playing); } });
addEventListener("resize", () => { viewer.set_3d_pane_size(innerWidth, innerHeight); look(); });

// jump.html#t=0.95&view=corner&show=both opens still, at that instant
const asked = new URLSearchParams(location.hash.slice(1));
for (const name of ["view", "show"])
  if ([...byId(name).options].some((o) => o.value === asked.get(name))) byId(name).value = asked.get(name);
viewer.set_3d_pane_size(innerWidth, innerHeight);
look();
choose();
seek(Number(asked.get("t")) || 0);
if (!asked.has("t")) play(true);
requestAnimationFrame(tick);
