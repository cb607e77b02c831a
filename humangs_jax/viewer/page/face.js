// Faces: an expression moves the means of the canonical Gaussians before skinning, as
// humangs_jax/avatar/face.py does. Gaussians that stay hidden are moved far away, where no camera
// looks. The skin is not stretched here.

const STAYS = 65535;            // the row of Gaussians that no expression moves
const IN_MOUTH = 255;           // seen between the lips
const AWAY = -1e4;              // metres
const SMALLEST_OPENING = 0.001; // metres; as in Python, with the next two
const BEFORE_LIPS = 0.004;
const SHOWN = 0.4;              // of a lid or of what the mouth shows, from which on it is there
// Regions of the sliders, by the beginning of the expression's name.
const REGIONS = [["Eyes", /^eye/], ["Brows", /^brow/], ["Cheeks and nose", /^(cheek|nose)/], ["Jaw and tongue", /^(jaw|tongue)/],
  ["Mouth", /^mouth/], ["Other", /./]];
// Idle movement: seconds between blinks, seconds of a blink, seconds between glances, how far eyes
// look, and seconds of a glance.
const BLINK_EVERY = [2, 6], BLINK_SECONDS = 0.18, GLANCE_EVERY = [0.8, 3.5], GLANCE = 0.35, GLANCE_SECONDS = 0.08;

function motionFace(motion, frame) {
  if (!motion?.faces) return null;
  const last = motion.faces.length - 1, first = Math.max(0, Math.min(last, Math.floor(frame)));
  const t = Math.min(Math.max(frame - first, 0), 1), a = motion.faces[first], b = motion.faces[Math.min(first + 1, last)];
  return a.map((x, i) => x + t * (b[i] - x));
}

// Writes scene.means for coefficients of expressions; null: a face at rest. Returns whether
// anything has changed.
function applyFace(scene, coefficients) {
  const { face } = scene.header, { arrays } = scene;
  if (!face) return false;
  const active = [];
  for (let e = 0; e < face.names.length; e++) if (coefficients && coefficients[e]) active.push(e);
  const key = active.map((e) => `${e}:${coefficients[e]}`).join();
  if (key === scene.faceKey) return false;
  scene.faceKey = key;
  const rows = arrays.face_directions.length / (3 * face.names.length), moves = new Float32Array(3 * rows);
  for (const e of active) {
    const share = coefficients[e] * face.step;
    for (let k = 0; k < 3 * rows; k++) moves[k] += share * arrays.face_directions[3 * rows * e + k];
  }
  const opened = openingOf(scene, active, coefficients), closed = face.blinks.map((e) => (e >= 0 && coefficients ? coefficients[e] : 0));
  const eyes = face.eyes.map((joint, side) => eyeTurn(scene, joint, side, active, coefficients));
  const first = scene.count - face.hidden, { means, shapedMeans } = scene;
  for (let i = 0; i < scene.count; i++) {
    const row = arrays.face_rows[i];
    let place = [shapedMeans[3 * i], shapedMeans[3 * i + 1], shapedMeans[3 * i + 2]];
    if (row !== STAYS) place = place.map((x, c) => x + moves[3 * row + c]);
    if (i >= first) {
      const by = arrays.face_shown[i - first];
      const shown = by === IN_MOUTH ? betweenLips(place, opened) : (coefficients ? 4 * coefficients[by] : 0);
      if (shown < SHOWN) place = [0, AWAY, 0];
    } else {
      for (let side = 0; side < 2; side++) {
        const share = arrays.face_eyes[2 * i + side];
        if (!share) continue;
        if (closed[side] * share > 128) place = [0, AWAY, 0];
        else if (eyes[side]) {
          const turned = add(eyes[side].at, matrixApply(eyes[side].turn, subtract(place, eyes[side].at)));
          place = add(place, scaled(subtract(turned, place), share / 255));
        }
      }
    }
    means.set(place, 3 * i);
  }
  return true;
}

function eyeTurn(scene, joint, side, active, coefficients) {
  const turn = [0, 0, 0];
  for (const e of active)
    for (let c = 0; c < 3; c++) turn[c] += coefficients[e] * scene.arrays.face_turns[6 * e + 3 * side + c];
  return turn.some((v) => v) ? { at: scene.rest[joint], turn: matrixFromQuat(quatFromAxisAngle(...turn)) } : null;
}

// Returns the center, half the width and half the height of the opening between the lips.
function openingOf(scene, active, coefficients) {
  const lips = Array.from(scene.arrays.face_lips);
  for (const e of active)
    for (let k = 0; k < 12; k++) lips[k] += coefficients[e] * scene.arrays.face_lip_directions[12 * e + k];
  const [upper, lower, left, right] = [0, 1, 2, 3].map((i) => lips.slice(3 * i, 3 * i + 3));
  const width = Math.max((left[0] - right[0]) / 2, SMALLEST_OPENING);
  return { center: scaled(add(upper, lower), 0.5), width, height: Math.max((upper[1] - lower[1]) / 2, 0) };
}

function betweenLips(place, { center, width, height }) {
  if (height < 1.4 * SMALLEST_OPENING) return 0;
  const radius = Math.hypot((place[0] - center[0]) / width, (place[1] - center[1]) / (height + SMALLEST_OPENING));
  return Math.max((1 - radius) / 0.3, (place[2] - center[2]) / BEFORE_LIPS);
}

// Makes the blinks and glances of a person who has nothing to do. Calls `change(coefficients)` when
// they change; null: none.
function makeIdle(face, change) {
  const between = ([low, high]) => low + Math.random() * (high - low);
  const now = () => performance.now() / 1000;
  let timer = 0, blinkAt = 0, glanceAt = 0, from = [0, 0], to = [0, 0], looked = 0;
  const index = (name) => face.names.indexOf(name);
  function coefficients() {
    const time = now(), out = new Float32Array(face.names.length);
    if (time > blinkAt + 2 * BLINK_SECONDS) blinkAt = time + between(BLINK_EVERY);
    const closing = Math.max(0, 1 - Math.abs((time - blinkAt) / (BLINK_SECONDS / 2) - 1));
    if (time > glanceAt) {
      [from, looked] = [to, time];
      to = [(2 * Math.random() - 1) * GLANCE, (2 * Math.random() - 1) * GLANCE * 0.5];
      glanceAt = time + between(GLANCE_EVERY);
    }
    const t = Math.min(1, (time - looked) / GLANCE_SECONDS), [x, y] = from.map((v, i) => v + t * (to[i] - v));
    const set = (name, value) => { if (index(name) >= 0) out[index(name)] = Math.max(0, value); };
    for (const name of face.blinks) if (name >= 0) out[name] = closing;
    set("eyeLookOutLeft", x); set("eyeLookInRight", x); set("eyeLookInLeft", -x); set("eyeLookOutRight", -x);
    for (const side of ["Left", "Right"]) { set(`eyeLookUp${side}`, y); set(`eyeLookDown${side}`, -y); }
    return out;
  }
  // Returns whether the eyes move now, or have just come to rest.
  function busy() {
    const time = now();
    return time > glanceAt || time < looked + 2 * GLANCE_SECONDS || (time > blinkAt && time < blinkAt + 2 * BLINK_SECONDS);
  }
  return {
    coefficients,
    get on() { return timer !== 0; },
    set(on) {
      clearInterval(timer);
      timer = on ? setInterval(() => { if (busy()) change(); }, 30) : 0;
      [blinkAt, glanceAt] = [now() + between(BLINK_EVERY), now() + between(GLANCE_EVERY)];
      change();
    },
  };
}
