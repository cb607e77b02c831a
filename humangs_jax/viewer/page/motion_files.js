// Motions that people drop onto the page: .npz (ours, AMASS, global_orient/body_pose files) and .bvh. Formats and their
// conventions are those of humangs_jax/data/motion/; a file that is refused says in one line what was expected.

const BODY_JOINTS = 22, HAND_NUMBERS = 45, FULL_JOINTS = 55;
const PELVIS = [0, -0.35, 0];  // where SMPL-X's root is in T-pose: worlds are turned about it
const CLEARLY_UP = 0.5;
const LARGEST_FILE = 512 * 2 ** 20;

// { quats, translations, fps } for the scene's joints.
async function readMotionFile(file, scene) {
  if (file.size > LARGEST_FILE) throw new Error(`${file.name}: larger than 512 MB`);
  const bytes = new Uint8Array(await file.arrayBuffer());
  try {
    if (/\.bvh$/i.test(file.name)) return retargetBvh(parseBvh(new TextDecoder().decode(bytes)), scene);
    if (/\.npz$/i.test(file.name)) return motionFromArrays(await readNpz(bytes), scene.parents.length);
  } catch (error) {
    throw new Error(`${file.name}: ${error.message}`);
  }
  throw new Error(`${file.name}: expected a motion as .npz (ours, AMASS) or .bvh`);
}

// ---- npz: a zip archive of npy arrays --------------------------------------------------------------------------------

async function readNpz(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), arrays = {};
  let end = bytes.length - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw new Error("not an npz archive, or cut short");
  let at = view.getUint32(end + 16, true);
  for (let n = view.getUint16(end + 10, true); n > 0; n--) {
    if (at + 46 > bytes.length || view.getUint32(at, true) !== 0x02014b50) throw new Error("a damaged npz archive");
    const method = view.getUint16(at + 10, true), [nameLength, extra, comment] = [28, 30, 32].map((o) => view.getUint16(at + o, true));
    const name = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + nameLength)).replace(/\.npy$/, "");
    const local = view.getUint32(at + 42, true);
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const data = bytes.subarray(start, start + view.getUint32(at + 20, true));
    if (method !== 0 && method !== 8) throw new Error(`key ${name}: compressed in an unknown way`);
    const array = readNpy(method === 8 ? new Uint8Array(await inflate(data, "deflate-raw")) : data, name);
    if (array) arrays[name] = array;
    at += 46 + nameLength + extra + comment;
  }
  return arrays;
}

// { shape, data } in row-major order; null for text and pickled objects, which are not read.
function readNpy(bytes, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.getUint8(0) !== 0x93) throw new Error(`key ${name}: not an npy array`);
  const wide = view.getUint8(6) > 1, start = wide ? 12 : 10;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, start + length));
  const type = /'descr':\s*'([<>|=]?)(\w+)'/.exec(header);
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1].match(/\d+/g) || []).map(Number);
  const get = type && {
    f8: "getFloat64", f4: "getFloat32", i8: "getBigInt64", u8: "getBigUint64", i4: "getInt32", u4: "getUint32",
    i2: "getInt16", u2: "getUint16", i1: "getInt8", u1: "getUint8",
  }[type[2]];
  if (!get) return null;
  const size = Number(type[2][1]), count = shape.reduce((a, b) => a * b, 1), data = new Float64Array(count);
  if (start + length + size * count > bytes.length) throw new Error(`key ${name}: cut short`);
  for (let i = 0; i < count; i++) data[i] = Number(view[get](start + length + i * size, type[1] !== ">"));
  const columnMajor = /'fortran_order':\s*True/.test(header) && shape.length > 1;
  return { shape, data: columnMajor ? toRowMajor(data, shape) : data };
}

function toRowMajor(data, shape) {
  const out = new Float64Array(data.length), index = shape.map(() => 0);
  for (let i = 0; i < out.length; i++) {
    let at = 0;
    for (let d = shape.length - 1; d >= 0; d--) at = at * shape[d] + index[d];
    out[i] = data[at];
    for (let d = shape.length - 1; d >= 0 && ++index[d] === shape[d]; d--) index[d] = 0;
  }
  return out;
}

function motionFromArrays(arrays, jointCount) {
  const numbers = (key, columns) => {
    const found = arrays[key];
    if (!found) throw new Error(`key ${key} is missing`);
    const frames = found.shape[0] || 0, width = found.data.length / Math.max(frames, 1);
    if (frames < 1 || !columns.includes(width))
      throw new Error(`key ${key}: expected frames of ${columns.join(" or ")} numbers, got shape (${found.shape})`);
    const bad = found.data.findIndex((v) => !Number.isFinite(v));
    if (bad >= 0) throw new Error(`key ${key}: expected finite numbers, got ${found.data[bad]} in frame ${Math.floor(bad / width)}`);
    return { frames, row: (f) => [...found.data.subarray(f * width, (f + 1) * width)] };
  };
  const rate = (keys, fallback) => {
    const key = keys.find((k) => arrays[k]), fps = key ? arrays[key].data[0] : fallback;
    if (!(fps > 0)) throw new Error(`key ${key || keys[0]}: expected a positive number of frames per second`);
    return fps;
  };
  const filled = (parts) => {  // 22 body joints, and jaw, eyes and fingers where there are any
    const [body, hands] = parts;
    return [...body.slice(0, 66), ...new Array(9).fill(0), ...(hands || new Array(2 * HAND_NUMBERS).fill(0))];
  };
  let poses, moves, fps, up;
  if (arrays.rotations) {
    poses = numbers("rotations", [3 * jointCount]);
    [moves, fps, up] = [numbers("translations", [3]), rate(["fps"], 0), "y"];
  } else {
    if (jointCount !== FULL_JOINTS) throw new Error(`such files are for ${FULL_JOINTS} joints, this avatar has ${jointCount}`);
    if (arrays.poses) {
      poses = numbers("poses", [165, 156, 72, 66]);
      const read = poses.row;
      poses.row = (f) => {
        const row = read(f);
        return row.length === 165 ? row : filled([row, row.length === 156 ? row.slice(66) : null]);
      };
      [moves, fps] = [numbers("trans", [3]), rate(["mocap_framerate", "mocap_frame_rate", "fps"], 0)];
    } else if (arrays.body_pose && arrays.global_orient) {
      const orient = numbers("global_orient", [3]), body = numbers("body_pose", [63]);
      const hands = ["left_hand_pose", "right_hand_pose"].map((key) => arrays[key] && numbers(key, [HAND_NUMBERS]));
      const hand = (side, f) => hands[side] ? hands[side].row(f) : new Array(HAND_NUMBERS).fill(0);
      poses = { frames: orient.frames, row: (f) => filled([[...orient.row(f), ...body.row(f)], [...hand(0, f), ...hand(1, f)]]) };
      [moves, fps] = [numbers("transl", [3]), rate(["fps", "mocap_framerate", "mocap_frame_rate"], 30)];
    } else {
      const keys = Object.keys(arrays).sort().join(", ") || "none";
      throw new Error(`expected the keys rotations (ours), poses (AMASS) or global_orient and body_pose, got ${keys}`);
    }
    up = arrays.poses ? "z" : "y";
  }
  if (moves.frames !== poses.frames) throw new Error(`${moves.frames} translations for ${poses.frames} poses`);
  const quats = [], translations = [];
  for (let f = 0; f < poses.frames; f++) {
    const row = poses.row(f), frame = [];
    for (let j = 0; j < row.length; j += 3) frame.push(quatFromAxisAngle(row[j], row[j + 1], row[j + 2]));
    quats.push(frame);
    translations.push(moves.row(f));
  }
  return arrays.rotations ? { quats, translations, fps } : turnedUp({ quats, translations, fps }, up);
}

// The world turned so that y is up: the axis along which the pelvis stands on average, or the format's own.
function turnedUp(motion, usual) {
  const mean = [0, 0, 0];
  for (const [root] of motion.quats) {
    const m = matrixFromQuat(root);
    for (let i = 0; i < 3; i++) mean[i] += m[3 * i + 1] / motion.quats.length;
  }
  const { axis, cosine } = nearestAxis(mean), turn = UPRIGHT[cosine < CLEARLY_UP ? usual : axis];
  const m = matrixFromQuat(turn);
  return {
    ...motion,
    quats: motion.quats.map(([root, ...others]) => [quatMultiply(turn, root), ...others]),
    translations: motion.translations.map((t) => subtract(matrixApply(m, add(t, PELVIS)), PELVIS)),
  };
}

// The axis that a vector points along most, and how far it does.
function nearestAxis(v) {
  const i = v.reduce((best, x, k) => (Math.abs(x) > Math.abs(v[best]) ? k : best), 0);
  return { axis: (v[i] < 0 ? "-" : "") + "xyz"[i], cosine: Math.abs(v[i]) };
}

const HALF = Math.SQRT1_2;
// The rotation that turns the named axis to +y.
const UPRIGHT = { y: [1, 0, 0, 0], "-y": [0, 1, 0, 0], z: [HALF, -HALF, 0, 0], "-z": [HALF, HALF, 0, 0], x: [HALF, 0, 0, HALF], "-x": [HALF, 0, 0, -HALF] };

// ---- BVH ----------------------------------------------------------------------------------------------------------------

// Joints with offsets, parents and channels, and the frames' numbers.
function parseBvh(text) {
  const words = text.split(/\s+/).filter(Boolean), joints = [];
  let at = 0, parent = -1;
  const next = () => {
    if (at >= words.length) throw new Error("cut short");
    return words[at++];
  };
  const number = () => {
    const word = next(), value = Number(word);
    if (!Number.isFinite(value)) throw new Error(`expected a number, got ${word}`);
    return value;
  };
  if (next() !== "HIERARCHY") throw new Error("not a BVH file: expected HIERARCHY first");
  const open = [];
  for (let word = next(); word !== "MOTION"; word = next()) {
    if (word === "ROOT" || word === "JOINT" || word === "End") {
      const name = next();
      open.push({ name: word === "End" ? "" : name.replace(/^.*[:|]/, ""), parent, channels: [], offset: [0, 0, 0] });
    } else if (word === "{") {
      joints.push(open.pop());
      parent = joints.length - 1;
    } else if (word === "}") parent = joints[parent]?.parent ?? -1;
    else if (word === "OFFSET") joints[parent].offset = [number(), number(), number()];
    else if (word === "CHANNELS") joints[parent].channels = Array.from({ length: number() }, () => next().toLowerCase());
    else throw new Error(`unknown word ${word}`);
  }
  if (next() !== "Frames:") throw new Error("expected Frames: after MOTION");
  const count = number();
  if (next() !== "Frame" || next() !== "Time:") throw new Error("expected Frame Time:");
  const seconds = number(), width = joints.reduce((sum, j) => sum + j.channels.length, 0), frames = [];
  if (!(seconds > 0) || count < 1) throw new Error("expected at least one frame and a positive Frame Time");
  if (width === 0 || words.length - at !== count * width)
    throw new Error(`expected ${count} frames of ${width} numbers, got ${words.length - at} numbers: cut short?`);
  for (let f = 0; f < count; f++) frames.push(Array.from({ length: width }, number));
  return { joints, frames, fps: 1 / seconds };
}

// Our joints by the names of others, lower case, letters and digits alone: CMU (cgspeed), Mixamo, LaFAN, MotionBuilder,
// Biovision, SMPL, Unreal. Sides are "left", "l" before and "l" behind. A joint of the file is taken once, by the first that
// wants it: "shoulder" is the upper arm where there is no other and else the collar bone.
const FINGERS = ["index", "middle", "pinky", "ring", "thumb"], KNUCKLES = [1, 2, 3];
const MIDDLE_NAMES = { pelvis: ["hips", "hip", "pelvis", "root"], neck: ["neck", "neck1", "neck01"], head: ["head"], jaw: ["jaw"] };
const SIDED_NAMES = {
  hip: ["upleg", "thigh", "hip"], knee: ["leg", "shin", "lowleg", "lowerleg", "calf", "knee"],
  ankle: ["ankle", "foot"], foot: ["toebase", "toe", "ball", "foot"],
  shoulder: ["arm", "uparm", "upperarm", "shldr", "shoulder"], collar: ["collar", "clavicle", "shoulder"],
  elbow: ["forearm", "lowarm", "lowerarm", "elbow"], wrist: ["hand", "wrist"], eye: ["eye"],
};
for (const finger of FINGERS) for (const i of KNUCKLES) SIDED_NAMES[finger + i] = [`hand${finger}${i}`, `${finger}${i}`, `${finger}0${i}`];
// Bones: a joint points to the next of its last chain that the file has; others are moved as their parents are.
const NEXT = {};
const chain = (...names) => names.forEach((name, i) => { NEXT[name] = names.slice(i + 1); });
chain("pelvis", "spine1", "spine2", "spine3", "neck", "head");
for (const side of ["left", "right"]) {
  chain(...["collar", "shoulder", "elbow", "wrist", "middle1"].map((name) => `${side}_${name}`));
  chain(...["hip", "knee", "ankle", "foot"].map((name) => `${side}_${name}`));
  for (const finger of FINGERS) chain(...KNUCKLES.map((i) => `${side}_${finger}${i}`));
}
const NEEDED = ["pelvis", ...["hip", "knee", "ankle", "shoulder", "elbow"].flatMap((name) => [`left_${name}`, `right_${name}`])];
const STANDING = -0.5;  // cosine between legs and spine below which a person can stand in a rest pose
const FEW = 5;  // joints that have to share the beginning of their names for it to be no part of them

// Index of the file's joint for each joint of ours that it has.
function matchBvh({ joints }, scene) {
  let plain = joints.map((j) => j.name.toLowerCase().replace(/[^a-z0-9]/g, ""));
  const named = plain.filter(Boolean);  // the ends of limbs have no names
  let start = 0;
  while (named.length >= FEW && named[0][start] !== undefined && named.every((name) => name[start] === named[0][start])) start++;
  plain = plain.map((name) => name.slice(start).replace(/^mixamorig\d*/, ""));
  const source = {}, taken = new Set();
  const find = (ours, theirs) => {
    if (!scene.names.includes(ours)) return;
    const found = theirs.map((name) => plain.indexOf(name)).find((i) => i >= 0 && !taken.has(i));
    if (found !== undefined) taken.add(source[ours] = found);
  };
  for (const [ours, theirs] of Object.entries(MIDDLE_NAMES)) find(ours, theirs);
  for (const [ours, theirs] of Object.entries(SIDED_NAMES))
    for (const side of ["left", "right"]) find(`${side}_${ours}`, theirs.flatMap((x) => [side + x, side[0] + x, x + side[0]]));
  assignSpine(joints, scene, source);
  const missing = NEEDED.filter((name) => source[name] === undefined);
  if (missing.length) throw new Error(`no joint for ${missing.join(", ")}: expected the names of CMU, Mixamo or LaFAN`);
  return source;
}

// Spines have one to five joints, called differently everywhere: ours are the first, the middle and the last of the file's.
function assignSpine(joints, scene, source) {
  const found = [];
  let at = joints[source.neck ?? source.head]?.parent ?? -1;
  for (; at >= 0 && at !== source.pelvis; at = joints[at].parent) found.unshift(at);
  const last = found.length - 1, ours = { spine3: last, spine1: last > 0 ? 0 : -1, spine2: last > 1 ? last >> 1 : -1 };
  for (const [name, i] of Object.entries(ours))
    if (at >= 0 && i >= 0 && scene.names.includes(name)) source[name] = found[i];
}

const transposed = (m) => [0, 3, 6, 1, 4, 7, 2, 5, 8].map((i) => m[i]);

// As humangs_jax/data/motion/skeleton.py: bones point where the file's bones point. A joint's rest frames are related by the
// rotation that turns our rest direction into the file's, carried down from the pelvis, whose is fixed by the hips' line and the
// up direction of the spine. Where nobody can stand like the rest pose, twists are 0 on average over the frames.
function retargetBvh(bvh, scene) {
  const source = matchBvh(bvh, scene);
  const place = bvh.joints.map(() => [0, 0, 0]);  // rest positions: parents stand before their children
  bvh.joints.forEach((joint, i) => { place[i] = joint.parent < 0 ? [0, 0, 0] : add(place[joint.parent], joint.offset); });
  const between = (a, b) => subtract(place[source[b]], place[source[a]]), theirs = (a, b) => normalized(between(a, b));
  const rest = (name) => scene.rest[scene.names.indexOf(name)];
  const top = ["spine3", "neck", "left_shoulder"].find((name) => source[name] !== undefined), spine = theirs("pelvis", top);
  const standing = dot(normalized(add(between("left_hip", "left_ankle"), between("right_hip", "right_ankle"))), spine) < STANDING;
  const upright = matrixFromQuat(UPRIGHT[standing ? nearestAxis(spine).axis : "y"]);
  const posed = bvh.frames.map((numbers) => {
    const { world, position } = poseBvh(bvh, numbers);
    return { world: world.map((m) => matrixMultiply(upright, m)), position: position.map((p) => matrixApply(upright, p)) };
  });

  const frameOf = (right, up) => {
    const x = normalized(right), z = normalized(cross(x, up)), y = cross(z, x);
    return [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];
  };
  const root = matrixMultiply(
    frameOf(theirs("right_hip", "left_hip"), spine),
    transposed(frameOf(subtract(rest("left_hip"), rest("right_hip")), subtract(rest(top), rest("pelvis")))),
  );
  const align = [], global = posed.map(() => []);  // our rest frame -> the file's rest frame; our joints in the world
  for (const j of scene.order) {
    const name = scene.names[j], p = scene.parents[j], child = (NEXT[name] || []).find((other) => source[other] !== undefined);
    align[j] = p < 0 ? root : align[p];
    if (p >= 0 && source[name] !== undefined && child) {
      const bone = normalized(subtract(rest(child), rest(name)));
      align[j] = matrixMultiply(matrixFromQuat(shortestTurn(matrixApply(align[j], bone), theirs(name, child))), align[j]);
      if (!standing) {
        const turns = posed.map(({ world }, f) => matrixMultiply(transposed(global[f][p]), matrixMultiply(world[source[name]], align[j])));
        align[j] = matrixMultiply(align[j], untwist(turns, bone));
      }
    }
    // joints that the file does not have go with their parents
    posed.forEach(({ world }, f) => { global[f][j] = source[name] !== undefined ? matrixMultiply(world[source[name]], align[j]) : global[f][p]; });
  }

  const legs = (at) => ["left_hip>left_knee", "left_knee>left_ankle"].reduce((sum, pair) => {
    const [a, b] = pair.split(">");
    return sum + Math.hypot(...subtract(at(b), at(a)));
  }, 0);
  const scale = legs(rest) / Math.max(legs((name) => posed[0].position[source[name]]), 1e-9);  // units, and the length of the steps
  const quats = global.map((frame) => frame.map((m, j) => quatFromMatrix(scene.parents[j] < 0 ? m : matrixMultiply(transposed(frame[scene.parents[j]]), m))));
  const moves = posed.map(({ position }) => scaled(position[source.pelvis], scale));
  const low = standing ? soles(place, source, matrixFromQuat(UPRIGHT[nearestAxis(spine).axis]), legs(rest) / Math.max(legs((name) => place[source[name]]), 1e-9)) : null;
  const steps = stepsOf(posed, source, scale, low), own = stepsOfBody(global, scene, source, moves);
  const translations = moves.map((move, f) => subtract(add(move, [0, steps[f] - own[f], 0]), rest("pelvis")));
  const whole = Math.round(bvh.fps);  // BVH has 0.0083333 for 120
  return { quats, translations, fps: Math.abs(bvh.fps - whole) < 1e-4 * bvh.fps ? whole : bvh.fps };
}

// The rotation about a bone that takes the mean twist about it out of rotations. The twist of (w, v) about b is 2 arg(w + i v.b).
function untwist(turns, bone) {
  let real = 0, imaginary = 0;
  for (const m of turns) {
    const [w, ...v] = quatFromMatrix(m), along = dot(v, bone);
    real += w * w - along * along;
    imaginary += 2 * w * along;
  }
  return matrixFromQuat(quatFromAxisAngle(...scaled(bone, -Math.atan2(imaginary, real))));
}

const feetOf = (source) => ["ankle", "foot"].map((kind) =>
  ["left", "right"].map((side) => `${side}_${kind}`).filter((name) => source[name] !== undefined)).filter((kind) => kind.length);

// How high the joints of the file's feet are above the lowest of them in a rest pose that stands.
function soles(place, source, upright, scale) {
  const names = feetOf(source).flat(), heights = names.map((name) => scale * matrixApply(upright, place[source[name]])[1]);
  return Object.fromEntries(names.map((name, i) => [name, heights[i] - Math.min(...heights)]));
}

// How high the feet are above the floor in each frame, which is where they are lowest. low: of each joint of the feet, how high it
// is when the foot stands; null: each kind as high as in its lowest frame.
function stepsOf(posed, source, scale, low) {
  const height = ({ position }, name) => scale * position[source[name]][1];
  const least = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);
  if (!low) {
    low = {};
    for (const kind of feetOf(source)) {
      const lowest = least(posed.map((frame) => Math.min(...kind.map((name) => height(frame, name)))));
      for (const name of kind) low[name] = lowest;
    }
  }
  const feet = posed.map((frame) => Math.min(...Object.keys(low).map((name) => height(frame, name) - low[name])));
  const floor = least(feet);
  return feet.map((y) => y - floor);
}

// The same of our body, above a floor at the height of its lowest joint in T-pose.
function stepsOfBody(global, scene, source, moves) {
  const feet = feetOf(source).flat().map((name) => scene.names.indexOf(name));
  const floor = Math.min(...feet.map((j) => scene.rest[j][1]));
  return global.map((frame, f) => {
    const place = (j) => {
      const p = scene.parents[j];
      return p < 0 ? moves[f] : add(place(p), matrixApply(frame[p], subtract(scene.rest[j], scene.rest[p])));
    };
    return Math.min(...feet.map((j) => place(j)[1] - (scene.rest[j][1] - floor)));
  });
}

// Rotations and places of all joints in the world.
function poseBvh({ joints }, numbers) {
  const axes = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] }, world = [], position = [];
  let at = 0;
  joints.forEach((joint, i) => {
    let local = [1, 0, 0, 0];
    const move = [...joint.offset];
    for (const channel of joint.channels) {
      const value = numbers[at++], axis = channel[0];
      if (channel.endsWith("position")) move["xyz".indexOf(axis)] = value;
      else local = quatMultiply(local, quatFromAxisAngle(...scaled(axes[axis], value * Math.PI / 180)));
    }
    const m = matrixFromQuat(local), p = joint.parent;
    world[i] = p < 0 ? m : matrixMultiply(world[p], m);
    position[i] = p < 0 ? move : add(position[p], matrixApply(world[p], move));
  });
  return { world, position };
}

function shortestTurn(from, to) {
  const c = dot(from, to);
  if (c < -0.999999) {
    const side = normalized(cross(from, Math.abs(from[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
    return [0, ...side];
  }
  return quatNormalize([1 + c, ...cross(from, to)]);
}

function quatFromMatrix(m) {
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = m;
  const all = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 + yy - xx - zz, 1 + zz - xx - yy];
  const best = all.indexOf(Math.max(...all));
  return quatNormalize([
    [all[0], zy - yz, xz - zx, yx - xy],
    [zy - yz, all[1], yx + xy, xz + zx],
    [xz - zx, yx + xy, all[2], zy + yz],
    [yx - xy, zx + xz, zy + yz, all[3]],
  ][best]);
}
