// The viewer of report.html: draws the scene from report_scene.py at the frame that the slider selects.
import {
  AmbientLight, BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, DirectionalLight, DoubleSide, GridHelper, Group,
  Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, PlaneGeometry, Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from 'three';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { toCreasedNormals } from 'three/examples/jsm/utils/BufferGeometryUtils.js';

const $ = (id) => document.getElementById(id), all = (selector) => [...document.querySelectorAll(selector)];
const TYPES = { u2: Uint16Array, u4: Uint32Array, f4: Float32Array };
let data, buffer, track, draw = () => {}, at = 0, playing = false, waiting = false;

const plain = ([type, offset, count]) => new TYPES[type](buffer, offset, count);
// The arrays contain differences of successive rows.  Sums overflow in the same way as the differences, so they are exact.
const summed = (array, width) => { for (let i = width; i < array.length; i++) array[i] += array[i - width]; return array; };
const levels = ({ values, low, step }) => Float32Array.from(summed(plain(values), low.length), (v, i) => low[i % low.length] + step[i % low.length] * v);

async function load() {
  buffer = await unpacked('arrays').arrayBuffer();
  data = JSON.parse($('scene').textContent);
  for (const t of data.tracks) {
    for (const key of ['poses', 'points', 'normals', 'ellipsoids', 'jumps', 'forces']) t[key] = t[key] && levels(t[key]);
    t.times = plain(t.times);
    t.curves = t.curves.map(plain);
    t.last = t.times.length - 1;
  }
}

// Returns `width` numbers, beginning at column k, of an array with a row for each frame, interpolated at frame `x`.
function row(array, width, k = 0, x = at) {
  const columns = array.length / (track.last + 1), i = Math.floor(x), j = Math.min(i + 1, track.last);
  return Array.from({ length: width }, (_, c) => array[i * columns + k + c] * (1 - x + i) + array[j * columns + k + c] * (x - i));
}
const vector = (array, k = 0) => new Vector3(...row(array, 3, k));

function geometry({ corners, faces }) {
  const found = new BufferGeometry();
  found.setAttribute('position', new BufferAttribute(levels(corners), 3));
  found.setIndex(new BufferAttribute(summed(plain(faces), 1), 1));
  return toCreasedNormals(found, 0.6);
}

const paint = (color, opacity, more) => new MeshBasicMaterial({ color, opacity, transparent: true, depthWrite: false, side: DoubleSide, ...more });

function robot(shapes, ghost) {
  const joints = data.joints.map(() => new Group());
  data.joints.forEach((joint, k) => k && joints[joint.parent].add(joints[k]));
  for (const part of data.parts) {
    const opacity = ghost ? 0.2 : part.color[3], color = ghost ? new Color(0x3366aa) : new Color().setRGB(...part.color.slice(0, 3), 'srgb');
    const look = { color, opacity, transparent: opacity < 1, depthWrite: opacity === 1, side: DoubleSide, roughness: 0.7 };
    const mesh = new Mesh(shapes[part.shape], new MeshStandardMaterial(look));
    mesh.position.fromArray(part.pose); mesh.quaternion.fromArray(part.pose, 3);
    joints[part.joint].add(mesh);
  }
  return joints;
}

function pose(joints) {
  joints.slice(1).forEach((joint, k) => {
    const found = row(track.poses, 7, 7 * k);
    joint.position.fromArray(found); joint.quaternion.fromArray(found, 3).normalize();
  });
  joints[0].updateMatrixWorld(true);
}

function arrow(color, radius) {
  const group = new Group(), look = paint(color, 1, { depthTest: false });
  group.add(new Mesh(new CylinderGeometry(radius, radius, 1, 12).translate(0, 0.5, 0), look));
  group.add(new Mesh(new ConeGeometry(3 * radius, 8 * radius, 16).translate(0, -4 * radius, 0), look));
  for (const part of group.children) part.renderOrder = 2;
  group.span = (from, along) => {
    const length = along.length(), head = Math.min(1, length / (12 * radius));
    group.visible = length > 0.01 * data.size;
    group.position.copy(from); group.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), along.normalize());
    group.children[0].scale.y = Math.max(length - 8 * radius * head, 1e-9);
    group.children[1].position.y = length; group.children[1].scale.setScalar(head || 1e-9);
  };
  return group;
}

function ellipsoid(i, color, opacity, wireframe) {
  const mesh = new Mesh(new SphereGeometry(1, ...(wireframe ? [14, 10] : [40, 24])), paint(color, opacity, { wireframe }));
  mesh.matrixAutoUpdate = false;
  mesh.place = () => {
    const [a, b, c, d, e, f] = row(track.ellipsoids, 6, 6 * i).map((v) => v * data.scale.ellipsoid), [x, y, z] = row(track.points, 3, 3 * i);
    mesh.matrix.set(a, b, c, x, b, d, e, y, c, e, f, z, 0, 0, 0, 1);
  };
  return mesh;
}

function wall({ kind, shape, point, normal, size }, shapes) {
  if (shape !== undefined) return new Mesh(shapes[shape], paint(0xb08a2e, 0.35));
  const group = new Group(), color = kind === 'ground' ? 0x888888 : 0x8a6a1c, grid = new GridHelper(size, 10, color, color);
  grid.rotation.x = Math.PI / 2;
  group.add(grid, new Mesh(new PlaneGeometry(size, size), paint(color, kind === 'ground' ? 0.08 : 0.25)));
  group.position.set(...point); group.quaternion.setFromUnitVectors(new Vector3(0, 0, 1), new Vector3(...normal));
  return group;
}

function stage(renderer) {
  const scene = new Scene(), camera = new PerspectiveCamera(35, 1, 0.01 * data.size, 50 * data.size), canvas = $('view');
  scene.background = new Color(0xf4f6f8); camera.up.set(0, 0, 1);
  const shapes = data.shapes.map(geometry), body = robot(shapes, false), ghost = robot(shapes, true), walls = data.walls.map((one) => wall(one, shapes));
  const contacts = [...Array(data.contacts).keys()], normals = contacts.map(() => arrow(0x000000, 0.004 * data.size));
  const force = arrow(0x0046a0, 0.008 * data.size), jumps = body.map(() => arrow(0xc24a00, 0.004 * data.size));
  const now = contacts.map((i) => ellipsoid(i, 0x0072b2, 0.35, false)), first = contacts.map((i) => ellipsoid(i, 0x883300, 0.45, true));
  const feet = data.feet.map(({ joint, point }) => {
    const ball = new Mesh(new SphereGeometry(0.012 * data.size, 16, 12), paint(0x1b7f3b, 1, { depthTest: false }));
    ball.position.set(...point); ball.renderOrder = 1; body[joint].add(ball);
    return ball;
  });
  scene.add(body[0], ghost[0], ...walls, ...normals, force, ...jumps, ...now, ...first, new AmbientLight(0xffffff, 1.1));
  for (const [x, y, z, power] of [[3, -4, 6, 1.5], [-4, 3, 2, 0.8]]) { const sun = new DirectionalLight(0xffffff, power); sun.position.set(x, y, z); scene.add(sun); }

  const controls = new OrbitControls(camera, canvas);
  controls.listenToKeyEvents(canvas); controls.addEventListener('change', () => show());
  const look = (direction) => {
    const far = 1.04 * data.radius / Math.tan(Math.PI * camera.fov / 360) / Math.min(1, camera.aspect);
    controls.target.set(...data.center);
    camera.position.copy(controls.target).addScaledVector(new Vector3(...direction).normalize(), far);
    controls.update();
  };
  const fit = () => {
    const { clientWidth, clientHeight } = canvas.parentElement;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2)); renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / clientHeight; camera.updateProjectionMatrix(); show();
  };
  for (const button of all('[data-look]')) button.onclick = () => look(button.dataset.look ? button.dataset.look.split(' ').map(Number) : data.eye);
  for (const box of all('#layers input')) box.onchange = () => show();
  $('layers').hidden = false; addEventListener('resize', fit); fit(); look(data.eye);

  const on = (name) => $('layers').querySelector(`[name=${name}]`)?.checked ?? false;
  return () => {
    const moved = at > 0.02 * track.last, here = at;
    if (data.ghost) { at = 0; pose(ghost); for (const one of first) one.place(); at = here; }
    pose(body); for (const one of now) one.place();
    normals.forEach((one, i) => one.span(vector(track.points, 3 * i), vector(track.normals, 3 * i).multiplyScalar(0.25 * data.size)));
    jumps.forEach((one, k) => {
      one.span(body[k].localToWorld(new Vector3(...data.joints[k].center)), vector(track.jumps, 3 * k).multiplyScalar(data.scale.jump));
      one.visible &&= on('jumps');
    });
    if (track.forces) { // The length grows with the square root, so that small forces are visible beside impacts.
      const f = vector(track.forces), along = f.clone().multiplyScalar(data.scale.force / Math.sqrt(f.length() || 1));
      force.span(vector(track.points).sub(along), along);
    }
    force.visible &&= !!track.forces && on('force'); body[0].visible = on('robot');
    // At the first frame, the robot and its ghost coincide and would flicker.
    ghost[0].visible = data.ghost && moved && on('ghost');
    for (const one of first) one.visible = data.ghost && moved && on('ellipsoids');
    for (const one of now) one.visible = on('ellipsoids');
    for (const one of [...walls, ...normals]) one.visible = on('surface');
    for (const one of feet) one.visible = on('feet');
    renderer.render(scene, camera); document.documentElement.dataset.ready = 'drawn';
  };
}

const format = (v) => (!Number.isFinite(v) ? 'undefined' : Math.abs(v) >= 1e5 ? v.toExponential(2) : String(+v.toPrecision(4)));
const span = () => track.times[track.last] - track.times[0];

function show() {
  const [time] = row(track.times, 1), share = (time - track.times[0]) / span(), charts = all(`[data-track="${data.tracks.indexOf(track)}"] [data-series]`);
  $('where').textContent = track.unit ? `t = ${time.toFixed(3)} ${track.unit}` : `${Math.round(100 * share)} % of the way`;
  $('slider').value = at; $('slider').setAttribute('aria-valuetext', $('where').textContent);
  track.curves.forEach((values, k) => {
    charts[k].querySelector('output').textContent = format(row(values, 1)[0]);
    for (const end of ['x1', 'x2']) charts[k].querySelector('.cursor').setAttribute(end, 60 + 330 * share);
  });
  if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; draw(); }); }
}
function go(frame) { at = Math.max(0, Math.min(track.last, frame)); show(); }
function seek(time) {
  const next = track.times.findIndex((t) => t > time), before = next < 0 ? track.last : Math.max(next - 1, 0);
  go(next < 1 ? before : before + (time - track.times[before]) / (track.times[next] - track.times[before]));
}
function choose(index) {
  track = data.tracks[index]; $('slider').max = track.last;
  for (const part of all('[data-track]')) part.hidden = part.dataset.track !== String(index);
  go(at);
}
function play() {
  playing = !playing; $('play').textContent = playing ? 'Pause' : 'Play';
  if (playing && at >= track.last) at = 0;
  let last = performance.now();
  const tick = (now) => {
    if (!playing) return;
    seek(row(track.times, 1)[0] + (now - last) / 1000 * (track.unit ? +$('speed').value : span() / 4)); last = now;
    if (at >= track.last) play(); else requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

async function main() {
  await load();
  $('controls').hidden = false; $('slider').oninput = () => go(+$('slider').value);
  $('first').onclick = () => go(0); $('end').onclick = () => go(track.last); $('play').onclick = play;
  if ($('track')) $('track').onchange = () => choose(+$('track').value);
  for (const svg of all('svg')) svg.onclick = (event) => seek(track.times[0] + (event.offsetX / svg.clientWidth * 400 - 60) / 330 * span());
  choose(0);
  // A link that ends in #0.5 opens the page at half of the frames.
  go(Number(location.hash.slice(1)) * track.last || 0);
  try {
    draw = stage(new WebGLRenderer({ canvas: $('view'), antialias: true }));
  } catch (error) {
    $('nogl').hidden = false; $('view').hidden = true; document.documentElement.dataset.ready = 'words'; console.warn(error);
  }
}
main();
