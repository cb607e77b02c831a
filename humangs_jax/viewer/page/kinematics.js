// Rotations, the tree of joints, and poses. The formulas are those of humangs_jax/body/model.py:
//   W_j = W_p R_j,   t_j = t_p + W_p (J_j - J_p),   G_j = [W_j | t_j - W_j J_j + translation].
// Quaternions are wxyz, matrices are row-major arrays of nine numbers.

function quatFromAxisAngle(x, y, z) {
  const angle = Math.hypot(x, y, z);
  const s = angle > 1e-8 ? Math.sin(angle / 2) / angle : 0.5;
  return [Math.cos(angle / 2), s * x, s * y, s * z];
}

function quatMultiply([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

const quatConjugate = ([w, x, y, z]) => [w, -x, -y, -z];

function quatNormalize(q) {
  const n = Math.hypot(...q);
  return n > 0 ? q.map((v) => v / n) : [1, 0, 0, 0];
}

// Interpolates rotations the shorter way round, at constant speed.
function quatSlerp(a, b, t) {
  let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = dot < 0 ? -1 : 1;
  dot = Math.min(1, Math.abs(dot));
  const angle = Math.acos(dot), sine = Math.sin(angle);
  const [u, v] = sine > 1e-6 ? [Math.sin((1 - t) * angle) / sine, Math.sin(t * angle) / sine] : [1 - t, t];
  return quatNormalize(a.map((x, i) => u * x + sign * v * b[i]));
}

function axisAngleFromQuat([w, x, y, z]) {
  if (w < 0) [w, x, y, z] = [-w, -x, -y, -z];
  const sine = Math.hypot(x, y, z);
  const s = sine > 1e-9 ? 2 * Math.atan2(sine, w) / sine : 2;
  return [s * x, s * y, s * z];
}

function matrixFromQuat([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

function matrixMultiply(a, b) {
  const out = new Array(9);
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  return out;
}

const matrixApply = (m, [x, y, z]) => [
  m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z,
];

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const normalized = (a) => scaled(a, 1 / Math.max(Math.hypot(...a), 1e-12));

// Returns the joints in an order in which parents come first.
function jointOrder(parents) {
  const order = [], done = new Set([-1]);
  while (order.length < parents.length) {
    const before = order.length;
    parents.forEach((p, j) => { if (done.has(p) && !done.has(j)) { order.push(j); done.add(j); } });
    if (order.length === before) throw new Error("the joints are no tree");
  }
  return order;
}

// Poses the joints. rest: joints [x, y, z]; quats: one per joint, relative to its parent. Returns
// the rows of G, Float32Array (12 j), and the joints in space.
function poseJoints(rest, parents, order, quats, translation) {
  const world = [], position = [], rows = new Float32Array(12 * parents.length);
  for (const j of order) {
    const p = parents[j], local = matrixFromQuat(quats[j]);
    world[j] = p < 0 ? local : matrixMultiply(world[p], local);
    position[j] = p < 0 ? rest[j] : add(position[p], matrixApply(world[p], subtract(rest[j], rest[p])));
    const offset = add(subtract(position[j], matrixApply(world[j], rest[j])), translation);
    for (let i = 0; i < 3; i++) {
      rows.set(world[j].slice(3 * i, 3 * i + 3), 12 * j + 4 * i);
      rows[12 * j + 4 * i + 3] = offset[i];
    }
  }
  return { rows, joints: position.map((p) => add(p, translation)) };
}

const A_POSE_DEGREES = 48;

// Returns the pose without rotations. Poses are { quats, translation }.
function restPose(count) {
  return { quats: Array.from({ length: count }, () => [1, 0, 0, 0]), translation: [0, 0, 0] };
}

function aPose(names) {
  const pose = restPose(names.length), angle = A_POSE_DEGREES * Math.PI / 180;
  const turn = (name, z) => {
    const j = names.indexOf(name);
    if (j >= 0) pose.quats[j] = quatFromAxisAngle(0, 0, z);
  };
  turn("left_shoulder", -angle);  // the left side is at +x, y is up
  turn("right_shoulder", angle);
  return pose;
}

// Returns the pose at a frame, interpolated between two frames. motion: { quats (frames of joints),
// translations, fps }.
function motionPose(motion, frame) {
  const last = motion.quats.length - 1;
  const first = Math.max(0, Math.min(last, Math.floor(frame))), t = Math.min(Math.max(frame - first, 0), 1);
  if (t === 0 || first === last) return { quats: motion.quats[first], translation: motion.translations[first] };
  const a = motion.translations[first], b = motion.translations[first + 1];
  return {
    quats: motion.quats[first].map((q, j) => quatSlerp(q, motion.quats[first + 1][j], t)),
    translation: a.map((x, i) => x + t * (b[i] - x)),
  };
}

// Moves a motion by a constant so that the person starts at x = z = 0 and, where lowest, stands on
// y = 0 (as body.motion.grounded).
function groundedMotion(motion, rest, parents, order, soleBelowJoint) {
  let lowest = Infinity, start = null;
  motion.quats.forEach((quats, i) => {
    const { joints } = poseJoints(rest, parents, order, quats, motion.translations[i]);
    start = start || joints[0];
    for (const joint of joints) lowest = Math.min(lowest, joint[1]);
  });
  const shift = [start[0], lowest - soleBelowJoint, start[2]];
  return { ...motion, translations: motion.translations.map((t) => subtract(t, shift)) };
}
