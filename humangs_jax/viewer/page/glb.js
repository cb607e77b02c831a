// Reads an animation of a GLB file for the joints of its skin, as read_animation in
// humangs_jax/motion/clips.py does. The rest pose is the one in which the skin was bound to the
// mesh, or that of the nodes if there is no skin. A place in space is { m: 3 x 3, t: [x, y, z] }.

const GLB_START = 0x46546c67, GLB_JSON = 0x4e4f534a, GLB_BINARY = 0x004e4942;
const GLB_PATHS = new Map([["translation", 3], ["rotation", 4], ["scale", 3]]);
const GLB_COLUMNS = new Map([["SCALAR", 1], ["VEC2", 2], ["VEC3", 3], ["VEC4", 4], ["MAT4", 16]]);
// For each component type: how a number is read, its number of bytes, and the integer that means 1
// if integers are normalized.
const GLB_NUMBERS = new Map([
  [5120, ["getInt8", 1, 127]], [5121, ["getUint8", 1, 255]], [5122, ["getInt16", 2, 32767]],
  [5123, ["getUint16", 2, 65535]], [5125, ["getUint32", 4, 4294967295]], [5126, ["getFloat32", 4, 1]],
]);
const SHOWN_CLIPS = 12;
const STEP_ROUNDING = 0.01;  // of a frame: keys are rounded to float32

// Returns a clip as in skeletons.js, with the names of all clips in the file. index: of the wanted
// clip.
function parseGlb(bytes, index = 0) {
  const { content, binary } = glbChunks(bytes);
  try {
    return glbClip(content, binary, index);
  } catch (error) {
    if (!(error instanceof TypeError || error instanceof RangeError)) throw error;
    throw new Error("a damaged GLB file: parts that it names are missing");
  }
}

function glbChunks(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 20 || view.getUint32(0, true) !== GLB_START || view.getUint32(16, true) !== GLB_JSON)
    throw new Error("not a GLB file, or cut short");
  const length = view.getUint32(12, true), next = 20 + length;
  if (next > bytes.length) throw new Error("a GLB file that is cut short");
  let content;
  try {
    content = JSON.parse(new TextDecoder().decode(bytes.subarray(20, next)));
  } catch {
    throw new Error("a GLB file with damaged JSON");
  }
  if (next + 8 > bytes.length) return { content, binary: null };
  if (view.getUint32(next + 4, true) !== GLB_BINARY)
    throw new Error("a GLB file with other chunks than JSON and one of numbers");
  const size = view.getUint32(next, true), start = next + 8;
  if (start + size > bytes.length) throw new Error("a GLB file that is cut short");
  return { content, binary: new DataView(bytes.buffer, bytes.byteOffset + start, size) };
}

function glbClip(content, binary, index) {
  const nodes = content.nodes ?? [], animations = content.animations ?? [];
  if (!animations.length)
    throw new Error("a GLB file without an animation: expected a skeleton in motion");
  const names = animations.map((each, i) => String(each.name ?? i));
  const listed = names.slice(0, SHOWN_CLIPS).join(", ") + (names.length > SHOWN_CLIPS ? ", ..." : "");
  const note = names.length > 1 && index === 0 ? `${names.length} animations (${listed}): the first is taken` : "";
  const parents = glbParents(nodes), { joints, binding } = glbJoints(content, binary, nodes);
  const order = withAncestors(joints, parents), tracks = glbTracks(content, binary, animations[index], new Set(order));
  const { times, fps } = glbTimes([...tracks.values()].flatMap((byPath) => [...byPath.values()]));
  const posed = times.map((_, frame) => placesOfNodes(nodes, parents, order, tracks, times, frame));
  const rest = placesOfNodes(nodes, parents, order, new Map(), [0], 0);
  const bound = joints.map((joint) => binding.get(joint) ?? rest.get(joint));
  const unbound = bound.map(({ m }) => transposed(rotationIn(m)));
  const own = posed.map((places) => ({
    world: joints.map((joint, i) => matrixMultiply(rotationIn(places.get(joint).m), unbound[i])),
    position: joints.map((joint) => places.get(joint).t),
  }));
  const humanoid = humanoidNames(content);
  const above = (joint) => {
    let parent = parents[joint];
    while (parent !== -1 && !joints.includes(parent)) parent = parents[parent];
    return joints.indexOf(parent);
  };
  const nameOf = (joint) => humanoid.get(joint) ?? String(nodes[joint].name ?? "");
  const named = joints.map((joint) => ({ name: nameOf(joint), parent: above(joint) }));
  return { joints: named, place: bound.map(({ t }) => t), own, fps, up: "y", note, names };
}

// ---- nodes ----

// Returns the names of bones by node, if the file has them (VRM). Its nodes may then have any
// names.
function humanoidNames(content) {
  for (const extension of Object.values(content.extensions ?? {})) {
    const bones = extension?.humanoid?.humanBones ?? {};
    const listed = Array.isArray(bones);  // of VRM 0
    const entries = listed ? bones.map((bone) => [bone?.bone, bone]) : Object.entries(bones);
    const placed = entries.filter(([, bone]) => Number.isInteger(bone?.node));
    if (placed.length) return new Map(placed.map(([name, bone]) => [bone.node, String(name)]));
  }
  return new Map();
}

function glbParents(nodes) {
  const parents = nodes.map(() => -1);
  nodes.forEach((node, i) => {
    for (const child of node.children ?? []) {
      if (parents[child] !== -1) throw new Error(`nodes: ${child} is no node, or has two parents`);
      parents[child] = i;
    }
  });
  return parents;
}

// Returns the nodes that are joints, and their places when the skin was bound, as far as the file
// has them.
function glbJoints(content, binary, nodes) {
  const skins = (content.skins ?? []).filter((skin) => skin.joints?.length);
  if (!skins.length) return { joints: nodes.map((_, i) => i), binding: new Map() };
  const skin = skins.reduce((best, each) => (each.joints.length > best.joints.length ? each : best));
  if (skin.joints.some((joint) => nodes[joint] === undefined))
    throw new Error("skins: a joint that is no node");
  const joints = [...new Set(skin.joints)];
  if (skin.inverseBindMatrices === undefined || joints.length !== skin.joints.length)
    return { joints, binding: new Map() };
  const matrices = readAccessor(content, binary, skin.inverseBindMatrices, "inverseBindMatrices");
  const bound = joints.map((joint, i) => [joint, invertedPlace(placeOfColumns(matrices[i]))]);
  return { joints, binding: new Map(bound) };
}

// Returns the joints and all nodes above them, parents first.
function withAncestors(joints, parents) {
  const order = new Set();
  for (const joint of joints) {
    const path = [];
    for (let at = joint; at !== -1 && !order.has(at); at = parents[at]) {
      if (path.length > parents.length) throw new Error("nodes: one lies below itself");
      path.push(at);
    }
    for (const at of path.reverse()) order.add(at);
  }
  return [...order];
}

const placeOfColumns = (c) => (
  { m: [c[0], c[4], c[8], c[1], c[5], c[9], c[2], c[6], c[10]], t: [c[12], c[13], c[14]] }
);

function invertedPlace({ m, t }) {
  const rows = [m.slice(0, 3), m.slice(3, 6), m.slice(6)];
  const columns = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])];
  const determinant = dot(rows[0], columns[0]);
  if (!(Math.abs(determinant) > 0)) throw new Error("inverseBindMatrices: one has no inverse");
  const inverse = transposed(columns.flat().map((v) => v / determinant));
  return { m: inverse, t: scaled(matrixApply(inverse, t), -1) };
}

function rotationIn(m) {
  const columns = [0, 1, 2].map((i) => [m[i], m[3 + i], m[6 + i]]);
  if (!(dot(columns[0], cross(columns[1], columns[2])) > 0))
    throw new Error("a joint that is mirrored or without size: expected rotations, positions and scales");
  return matrixFromQuat(quatFromMatrix(transposed(columns.flatMap(normalized))));
}

// Returns the place of each node in `order` in a frame, as a Map.
function placesOfNodes(nodes, parents, order, tracks, times, frame) {
  const places = new Map();
  for (const i of order) {
    const local = localPlace(nodes[i], tracks.get(i), times, frame), above = places.get(parents[i]);
    places.set(i, above ? placeBelow(above, local) : local);
  }
  return places;
}

const placeBelow = (above, local) => (
  { m: matrixMultiply(above.m, local.m), t: add(above.t, matrixApply(above.m, local.t)) }
);

function localPlace(node, moving, times, frame) {
  if (node.matrix) return placeOfColumns(checkedNumbers(node.matrix, 16, "matrix"));
  const still = { translation: [0, 0, 0], rotation: [0, 0, 0, 1], scale: [1, 1, 1] };
  const [translation, [x, y, z, w], scale] = [...GLB_PATHS].map(([path, width]) => {
    const track = moving?.get(path);
    if (track) return sampledTrack(track, path, times, frame);
    return checkedNumbers(node[path] ?? still[path], width, path);
  });
  const turn = matrixFromQuat(quatNormalize([w, x, y, z]));
  return { m: turn.map((v, i) => v * scale[i % 3]), t: translation };
}

function checkedNumbers(values, width, what) {
  if (values.length !== width || !values.every(Number.isFinite))
    throw new Error(`${what}: expected ${width} finite numbers`);
  return values;
}

// ---- numbers and tracks ----

// Returns rows of numbers. Normalized integers are converted to numbers up to 1.
function readAccessor(content, binary, index, what) {
  const accessor = content.accessors[index];
  if (accessor.sparse || accessor.bufferView === undefined)
    throw new Error(`${what}: numbers that are mostly zeros (sparse): expected all of them`);
  const view = content.bufferViews[accessor.bufferView];
  const compressed = Object.keys(view.extensions ?? {}).find((name) => /compression/.test(name));
  if (compressed)
    throw new Error(`${what}: compressed (${compressed}): export the file without compression`);
  if (view.buffer !== 0 || content.buffers?.[0]?.uri !== undefined || !binary)
    throw new Error("numbers in another file: expected a GLB file that holds all of its own");
  const columns = GLB_COLUMNS.get(accessor.type), { count, normalized: shares } = accessor;
  const [get, width, one] = GLB_NUMBERS.get(accessor.componentType);
  const start = (view.byteOffset ?? 0) + (accessor.byteOffset ?? 0), step = view.byteStride ?? columns * width;
  const end = start + (count - 1) * step + columns * width;
  if (!(count >= 0 && start >= 0 && step > 0) || (count > 0 && end > binary.byteLength))
    throw new Error(`${what}: ${count} rows up to byte ${end}, but there are ${binary.byteLength} bytes`);
  const read = (row, column) => {
    const value = binary[get](start + row * step + column * width, true);
    return shares ? Math.max(value / one, -1) : value;
  };
  const inRow = (row) => Array.from({ length: columns }, (_, column) => read(row, column));
  const rows = Array.from({ length: count }, (_, row) => inRow(row));
  if (!rows.every((row) => row.every(Number.isFinite))) throw new Error(`${what}: expected finite numbers`);
  return rows;
}

// Returns the tracks by node, then by path: { times, values, stepped }.
function glbTracks(content, binary, animation, wanted) {
  const tracks = new Map();
  for (const { target, sampler: index } of animation.channels) {
    const { node, path } = target, width = GLB_PATHS.get(path);
    if (!wanted.has(node) || !width) continue;
    if (!tracks.has(node)) tracks.set(node, new Map());
    const byPath = tracks.get(node), sampler = animation.samplers[index];
    if (byPath.has(path)) throw new Error(`animation: two tracks for the ${path} of node ${node}`);
    const times = readAccessor(content, binary, sampler.input, "times").map(([time]) => time);
    let values = readAccessor(content, binary, sampler.output, path);
    if (sampler.interpolation === "CUBICSPLINE")
      values = values.filter((_, i) => i % 3 === 1);  // between the tangents
    const increasing = times.every((time, i) => i === 0 || time > times[i - 1]);
    const fitting = values.length === times.length && values.every((row) => row.length === width);
    if (!times.length || !increasing || !fitting)
      throw new Error(`animation: expected one ${path} for each of increasing times`);
    byPath.set(path, { times, values, stepped: sampler.interpolation === "STEP" });
  }
  if (![...tracks.values()].some((byPath) => byPath.has("rotation")))
    throw new Error("an animation that turns no joint: expected a skeleton in motion");
  return tracks;
}

// Returns the times of the frames, seconds, as dense as those of the densest track, and their rate.
function glbTimes(tracks) {
  const first = least(tracks.map(({ times }) => times[0]));
  const last = largest(tracks.map(({ times }) => times.at(-1)));
  const dense = tracks.reduce((best, { times }) => (times.length > best.length ? times : best), []);
  if (dense.length < 2 || !(last > first)) return { times: [first], fps: RULES.DEFAULT_FPS };
  let fps = (dense.length - 1) / (dense.at(-1) - dense[0]);
  if (Math.round((last - first) * fps) + 1 > 4 * dense.length)
    throw new Error("animation: tracks of very different lengths");
  // keys may be left out, see frame_times in humangs_jax/motion/rules.py
  const steps = tracks.flatMap(({ times }) => times.slice(1).map((time, i) => time - times[i])).sort((a, b) => a - b);
  const shortest = steps[Math.floor(RULES.SHORT_STEPS * (steps.length - 1))];
  if (shortest * fps < 0.99) {
    fps = Math.max(fps, Math.min(1 / shortest, RULES.FRAMES_A_KEY * fps));
    if (Math.abs(fps - Math.round(fps)) < 0.01 * fps) fps = Math.round(fps);
  }
  const count = Math.round((last - first) * fps) + 1;
  return { times: Array.from({ length: count }, (_, i) => first + i / fps), fps };
}

function sampledTrack({ times: keys, values, stepped }, path, times, frame) {
  const whole = stepped || keys.length === 1, step = times.length > 1 ? times[1] - times[0] : 1;
  const inside = Math.min(Math.max(times[frame], keys[0]), keys.at(-1));
  const time = whole ? times[frame] + STEP_ROUNDING * step : inside;
  const before = lastKey(keys, time), after = Math.min(before + 1, keys.length - 1);
  if (whole || after === before) return values[before];
  const share = (time - keys[before]) / (keys[after] - keys[before]);
  const [a, b] = [values[before], values[after]];
  if (path === "rotation") return quatSlerp(quatNormalize(a), quatNormalize(b), share);
  return a.map((v, i) => v + share * (b[i] - v));
}

// Returns the index of the last key that is not after a time, or of the first key if all are.
function lastKey(keys, time) {
  let low = 0, high = keys.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (keys[middle] <= time) low = middle + 1;
    else high = middle;
  }
  return Math.max(low - 1, 0);
}
