// Motions that people drop onto the page: .npz (ours, AMASS and others), .bvh (skeletons.js) and
// .glb (glb.js). Formats, conventions and tables (RULES, from rules.py) are those of
// humangs_jax/motion/. An error about a refused file says in one line what was expected. Text from
// a file is never used as a key of an object, because objects have keys such as "constructor".

const LARGEST_FILE = 512 * 2 ** 20;

// Returns { quats, translations, fps, note, clips } for the scene's joints. note: lines about the
// file for the user. clips: names of the motions, if the file has several. clip: index of the
// wanted one. rate: frames per second that the user gave; null: those of the file. An error that
// has `asksRate` can be answered with a rate.
async function readMotionFile(file, scene, rate = null, clip = 0) {
  if (file.size > LARGEST_FILE) throw new Error(`${file.name}: larger than 512 MB`);
  const bytes = new Uint8Array(await file.arrayBuffer()), text = () => new TextDecoder().decode(bytes);
  try {
    if (/\.bvh$/i.test(file.name)) return checkedMotion(retargeted(parseBvh(text(), rate), scene));
    if (/\.(glb|vrma)$/i.test(file.name)) return checkedMotion(retargeted(parseGlb(bytes, clip), scene));
    if (/\.(npz|smpl)$/i.test(file.name)) return checkedMotion(motionFromArrays(await readNpz(bytes), scene, rate));
  } catch (error) {
    throw Object.assign(new Error(`${file.name}: ${error.message}`), { asksRate: Boolean(error.asksRate) });
  }
  throw new Error(`${file.name}: expected a motion as .npz (ours, AMASS), .bvh or .glb`);
}

const rateError = (message) => Object.assign(new Error(message), { asksRate: true });

// Returns the motion if all its numbers can be drawn, and throws if not, because wrong numbers
// would stop the page.
function checkedMotion(motion) {
  if (!(motion.fps > 0 && Number.isFinite(motion.fps) && Number.isFinite(1 / motion.fps)))
    throw rateError(`expected a positive number of frames per second, got ${motion.fps}`);
  if (!motion.quats.every((frame) => frame.every((q) => q.every(Number.isFinite)))) throw new Error("expected rotations and a skeleton of finite size");
  const farthest = largest(motion.translations.flat().map(Math.abs));
  if (!(farthest <= RULES.LARGEST_DISTANCE))
    throw new Error(`expected metres, at most ${RULES.LARGEST_DISTANCE} from the origin, got ${farthest}`);
  return motion;
}

const largest = (values) => values.reduce((a, b) => (b > a || Number.isNaN(b) ? b : a), -Infinity);
const least = (values) => -largest(values.map((v) => -v));
const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;

// ---- npz: a zip archive of npy arrays --------------------------------------------------------------------------------

// Returns the arrays of an archive by name, as a Map.
async function readNpz(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), arrays = new Map();
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
    if (array) arrays.set(name, array);
    at += 46 + nameLength + extra + comment;
  }
  return arrays;
}

const READERS = new Map(Object.entries({
  f8: "getFloat64", f4: "getFloat32", i8: "getBigInt64", u8: "getBigUint64", i4: "getInt32", u4: "getUint32",
  i2: "getInt16", u2: "getUint16", i1: "getInt8", u1: "getUint8",
}));

// Returns { shape, data } in row-major order; null for text and pickled objects, which are not
// read.
function readNpy(bytes, name) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.getUint8(0) !== 0x93) throw new Error(`key ${name}: not an npy array`);
  const wide = view.getUint8(6) > 1, start = wide ? 12 : 10;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, start + length));
  const type = /'descr':\s*'([<>|=]?)(\w+)'/.exec(header);
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1].match(/\d+/g) || []).map(Number);
  const get = type && READERS.get(type[2]);
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

function motionFromArrays(arrays, scene, asked = null) {
  const format = RULES.FORMATS.find(({ keys }) => keys.every((key) => arrays.has(key)));
  if (!format) {
    const expected = [...new Set(RULES.FORMATS.map(({ keys }) => keys[0]))].join(", ");
    throw new Error(`no motion: expected one of the keys ${expected}, got ${[...arrays.keys()].sort().join(", ") || "none"}`);
  }
  const count = scene.parents.length, full = largest(RULES.COLUMNS);
  if (format.kind !== "ours" && 3 * count !== full) throw new Error(`such files are for ${full / 3} joints, this avatar has ${count}`);
  // reads rows of numbers whose width is one of `widths`
  const numbers = (key, widths, amount = null) => {
    const found = arrays.get(key);
    if (!found) throw new Error(`key ${key} is missing`);
    const frames = amount === 1 || found.shape.length === 1 ? 1 : found.shape[0] || 0, width = found.data.length / Math.max(frames, 1);
    if (frames < 1 || !widths.includes(width) || (amount !== null && frames !== amount)) {
      const wanted = `${amount === null ? "" : `${amount} `}frames of ${widths.join(" or ")} numbers`;
      throw new Error(`key ${key}: expected ${wanted}, got shape (${found.shape})`);
    }
    const bad = found.data.findIndex((v) => !Number.isFinite(Math.fround(v)));
    if (bad >= 0) throw new Error(`key ${key}: expected finite numbers, got ${found.data[bad]} in frame ${Math.floor(bad / width)}`);
    return { frames, width, row: (f) => [...found.data.subarray(f * width, (f + 1) * width)] };
  };
  const first = (keys) => keys.find((key) => arrays.has(key)) ?? keys[0];
  const poses = posesOf(format, numbers, arrays, count), key = first(format.moves);
  const still = format.stays && !arrays.has(key), moves = still ? null : numbers(key, [3], poses.length);
  const rate = first(format.rates), given = asked !== null || arrays.has(rate);
  const fps = asked ?? (given ? arrays.get(rate).data[0] : format.fps);
  if (fps === null) throw rateError(`key ${rate}: missing: how many frames are a second?`);
  if (!(fps > 0 && Number.isFinite(fps)))
    throw rateError(`key ${rate}: expected a positive number of frames per second, got ${fps}`);
  const scale = format.scaling === null ? 1 : arrays.get(format.scaling)?.data[0] ?? RULES.MILLIMETRES;
  if (!(scale > 0)) throw new Error(`key ${format.scaling}: expected a positive number, got ${scale}`);
  // positions in the coordinates of a camera, whose y points down, perhaps by an assumed focal length
  const ofCamera = !still && RULES.CAMERA_MOVES.includes(key);
  const axes = ofCamera && format.also.includes("-y") ? { ...format, up: "-y", also: ["y"] } : format;
  const nearer = ofCamera && median(poses.map((_, f) => moves.row(f)[2])) > RULES.FAR ? RULES.ASSUMED_FOCAL : 1;
  const move = (f) => { const [x, y, z] = moves.row(f); return scaled([x, y, z / nearer], 1 / scale); };
  const translations = poses.map((_, f) => (still ? [0, 0, 0] : move(f)));
  const motion = turnedUp({ quats: poses, translations, fps }, axes, scene);
  const notes = [still && RULES.NO_PLACES.replace("{}", format.moves.slice(0, 3).join(", "))];
  notes.push(nearer > 1 && RULES.NEARER.replace("{}", key).replace("{:.3g}", nearer.toPrecision(3)));
  notes.push(!given && !format.fixed && RULES.NO_RATE.replace("{:g}", fps));
  return { ...motion, note: [...notes, motion.note].filter(Boolean).join("; ") };
}

// Returns the quaternions of all joints in each frame. A format has parts, each with a place in
// PLACES: the first joint and the number of joints.
function posesOf(format, numbers, arrays, count) {
  let frames = null;
  for (const [place, key] of Object.entries(format.poses)) {
    if (frames && !arrays.has(key)) continue;
    const [at, most] = format.kind === "ours" ? [0, count] : RULES.PLACES[place];
    const counts = place === "all" && format.kind !== "ours" ? RULES.COLUMNS.map((n) => n / 3) : [most];
    if (place === "limbs" || place === "body") counts.push(most + 2);  // SMPL's last two are whole hands
    const part = numbers(key, counts.flatMap((n) => (format.kind === "ours" ? [3 * n] : [3 * n, 9 * n])), frames && frames.length);
    const angles = counts.includes(part.width / 3), joints = part.width / (angles ? 3 : 9);
    frames ??= Array.from({ length: part.frames }, () => Array.from({ length: count }, () => [1, 0, 0, 0]));
    frames.forEach((quats, f) => {
      const row = part.row(f);
      for (let j = 0; j < joints; j++) {
        const to = placeOf(j, joints, at, most, place);
        if (to === null) continue;
        quats[to] = angles ? quatFromAxisAngle(...row.slice(3 * j, 3 * j + 3)) : quatFromMatrix(rotationMatrix(row.slice(9 * j, 9 * j + 9), key));
      }
    });
  }
  return frames;
}

// Returns our joint for the j-th joint of a part; null for none. In whole poses, SMPL-H's fingers
// follow the body, and SMPL's hands are left out.
function placeOf(j, joints, at, most, place) {
  const body = RULES.BODY_NUMBERS / 3, fingers = 2 * RULES.HAND_NUMBERS / 3;
  if (place !== "all" || joints === most || j < body) return j < most ? at + j : null;
  return joints === body + fingers ? most - joints + j : null;
}

function rotationMatrix(m, key) {
  const square = matrixMultiply(m, transposed(m));
  if (!square.every((v, i) => Math.abs(v - Number(i % 4 === 0)) < RULES.ORTHONORMAL)) throw new Error(`key ${key}: expected rotation matrices`);
  return m;
}

// ---- Which way is up: as humangs_jax/motion/rules.py --------------------------------------------------------------

// Turns the world so that y is up.
function turnedUp(motion, format, scene) {
  const frames = motion.quats.length, axes = motion.quats.map(([root]) => matrixFromQuat(root));
  const { axis, cosine } = nearestAxis([1, 4, 7].map((i) => mean(axes.map((m) => m[i])))), { PELVIS } = RULES;
  let up = format.up, note = "";
  if (!format.fixed && cosine >= RULES.CLEARLY_UP && axis !== up) {
    const places = (f) => poseJoints(scene.rest, scene.parents, scene.order, motion.quats[f], motion.translations[f]).joints;
    ({ up, note } = upAxis(sampledFrames(frames).map(places), axis, format.up, motion.fps, RULES.HANDS, format.also));
  }
  if (up === "y") return { ...motion, note };
  const turn = RULES.UPRIGHT[up], m = uprightMatrix(up);
  return {
    ...motion, note,
    quats: motion.quats.map(([root, ...others]) => [quatMultiply(turn, root), ...others]),
    translations: motion.translations.map((t) => subtract(matrixApply(m, add(t, PELVIS)), PELVIS)),
  };
}

// Returns the axis along which a vector points most, and its component there.
function nearestAxis(v) {
  const i = v.reduce((best, x, k) => (Math.abs(x) > Math.abs(v[best]) ? k : best), 0);
  return { axis: (v[i] < 0 ? "-" : "") + "xyz"[i], cosine: Math.abs(v[i]) };
}

const uprightMatrix = (axis) => matrixFromQuat(RULES.UPRIGHT[axis]).map(Math.round);

// Returns the frames in which a floor is looked for: evenly spread frames, each followed by the
// next one.
function sampledFrames(count) {
  const amount = Math.min(Math.max(count - 1, 1), RULES.MOST_FRAMES), last = Math.max(count - 2, 0);
  const first = Array.from({ length: amount }, (_, i) => (amount > 1 ? Math.floor((i * last) / (amount - 1)) : 0));
  return [...new Set(first)].flatMap((f) => [f, Math.min(f + 1, count - 1)]);
}

// Finds the axis that is up. Returns { up, note }. points: joints in space, in pairs of frames.
// hands: indices of the joints on which a person stands who is upside down.
function upAxis(points, stands, usual, fps, hands, also = []) {
  const { ON_THE_FLOOR: enough } = RULES, opposite = stands !== usual && stands.at(-1) === usual.at(-1);
  const [here, there] = floorsOf(points, [usual, stands], fps), none = { up: usual, note: "" };
  if (here < enough && there >= enough && here <= 0.5 * there)
    return { up: stands, note: `${stands} is up, not ${usual} as usual in such files: people stand and step on a floor below it` };
  const contradicted = there < enough && here >= enough && there <= 0.5 * here;
  if (also.includes(stands) && !contradicted && !(opposite && onHands(points, usual, hands)))
    return { up: stands, note: `${stands} is up, not ${usual}: people stand along it` };
  if (contradicted || opposite) return none;
  return { up: usual, note: `${usual} is up, as usual in such files, and people lie along ${stands}` };
}

// Returns the height of the lowest point above the origin, and its index, in the first frame of
// each pair.
function lowestPoints(points, axis) {
  const m = uprightMatrix(axis);
  return points.filter((_, f) => f % 2 === 0).map((frame) => {
    const heights = frame.map((p) => matrixApply(m, p)[1]), height = least(heights);
    return { height, index: heights.indexOf(height) };
  });
}

// Returns, for the usual axis and for another one, the share of the frames in which something is on
// the floor. For the other axis more evidence is needed.
function floorsOf(points, axes, fps) {
  const moves = [];
  for (let f = 0; f < points.length; f += 2) moves.push(points[f].map((p, j) => fps * Math.hypot(...subtract(points[f + 1][j], p))));
  const limit = Math.max(RULES.STILL[0], RULES.STILL[1] * mean(moves.map(mean)));
  const found = axes.map((axis) => {
    const lowest = lowestPoints(points, axis), usual = median(lowest.map(({ height }) => height));
    const level = lowest.map(({ height }) => Math.abs(height - usual) <= RULES.FLOOR_BAND);
    return { level: mean(level.map(Number)), resting: mean(lowest.map(({ index }, i) => Number(level[i] && moves[i][index] <= limit))) };
  });
  const rests = found.some(({ resting }) => resting >= RULES.ON_THE_FLOOR);  // on a treadmill nothing rests
  return found.map(({ level, resting }, i) => (rests ? resting : i === 0 || level >= RULES.TREADMILL ? level : 0));
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b), half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : 0.5 * (sorted[half - 1] + sorted[half]);
}

const onHands = (points, up, hands) => mean(lowestPoints(points, up).map(({ index }) => Number(hands.includes(index)))) > 0.5;
