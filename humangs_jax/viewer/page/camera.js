// The camera that people steer, on a sphere around a target. Axes are OpenCV's (x right, y down, z
// forward), and y is up in the world.

const FIELD_OF_VIEW = Math.PI / 6;  // vertical; narrow enough that a person keeps natural proportions
const HIGHEST = 1.55;               // radians: never over the head

function makeOrbit(target, distance) {
  return { target: [...target], distance, azimuth: 0.35, elevation: 0.1 };
}

// Returns the camera of an orbit: { K: [fx, fy, cx, cy], rotation: rows of cam_from_world,
// translation, eye, width, height }. right, bottom: pixels that panels cover. The target is in the
// middle of the other pixels.
function orbitCamera(orbit, width, height, follow, right = 0, bottom = 0) {
  const { distance, azimuth, elevation } = orbit, target = add(orbit.target, follow);
  const flat = Math.cos(elevation);
  const eye = add(target, scaled([flat * Math.sin(azimuth), Math.sin(elevation), flat * Math.cos(azimuth)], distance));
  const forward = normalized(subtract(target, eye));
  const across = normalized(cross(forward, [0, 1, 0])), rotation = [...across, ...cross(forward, across), ...forward];
  const free = [Math.max(1, width - right), Math.max(1, height - bottom)];
  const focal = 0.5 * Math.min(free[1], 1.25 * free[0]) / Math.tan(FIELD_OF_VIEW / 2);
  const K = [focal, focal, free[0] / 2, free[1] / 2];
  return { K, rotation, translation: scaled(matrixApply(rotation, eye), -1), eye, width, height };
}

// Returns the camera for K (3 x 3) and cam_from_world (4 x 4), as Python has them.
function exactCamera({ K, cam_from_world: m, width, height }) {
  const rotation = [...m[0].slice(0, 3), ...m[1].slice(0, 3), ...m[2].slice(0, 3)];
  const translation = [m[0][3], m[1][3], m[2][3]];
  const transposed = [0, 3, 6, 1, 4, 7, 2, 5, 8].map((i) => rotation[i]);
  const eye = scaled(matrixApply(transposed, translation), -1);
  return { K: [K[0][0], K[1][1], K[0][2], K[1][2]], rotation, translation, eye, width, height };
}

// Lets people steer the camera. Mouse: the left button turns, the right one (or shift) moves, the
// wheel zooms. Touch: one finger turns, two fingers move and zoom.
function steerOrbit(orbit, canvas, changed, reset) {
  const pointers = new Map();
  const turn = (dx, dy) => {
    const speed = 4.5 / Math.min(canvas.clientHeight, 900);
    orbit.azimuth -= dx * speed;
    orbit.elevation = Math.max(-HIGHEST, Math.min(HIGHEST, orbit.elevation + dy * speed));
  };
  const move = (dx, dy) => {
    const metres = 2 * orbit.distance * Math.tan(FIELD_OF_VIEW / 2) / canvas.clientHeight;
    const { rotation } = orbitCamera(orbit, 1, 1, [0, 0, 0]);
    const by = (row, s) => scaled(rotation.slice(row, row + 3), s);
    orbit.target = add(orbit.target, add(by(0, -dx * metres), by(3, -dy * metres)));
  };
  const zoom = (factor) => { orbit.distance = Math.max(0.15, Math.min(60, orbit.distance * factor)); };
  const centre = () => {
    const all = [...pointers.values()];
    return { x: all.reduce((s, p) => s + p.x, 0) / all.length, y: all.reduce((s, p) => s + p.y, 0) / all.length };
  };
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.max(1, Math.hypot(a.x - b.x, a.y - b.y));
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.focus({ preventScroll: true });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const here = { x: event.clientX, y: event.clientY };
    if (pointers.size >= 2) {
      const c = centre(), s = spread();
      pointers.set(event.pointerId, here);
      const d = centre();
      move(d.x - c.x, d.y - c.y);
      if (pointers.size === 2) zoom(s / spread());
    } else {
      pointers.set(event.pointerId, here);
      const sideways = event.shiftKey || (event.buttons & 6);
      (sideways ? move : turn)(here.x - last.x, here.y - last.y);
    }
    changed();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    zoom(Math.exp(Math.max(-120, Math.min(120, event.deltaY * lines)) * 0.0015));
    changed();
  }, { passive: false });
  return { turn, move, zoom };
}
