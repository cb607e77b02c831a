// Converts skeletons of other programs in motion to the scene's joints, as
// humangs_jax/motion/clips.py and skeleton.py do.

const CHANNELS = ["xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation"];

// Reads a BVH file into a clip, which is a skeleton in motion: { joints: [{ name, parent }], place,
// own, fps, up, note }. place: joints in the rest pose, in which nothing is turned. own: for each
// frame { world: rotations from the rest pose, position }. up: the axis that is up in the format;
// null: found from the rest pose. rate: frames per second in place of those of the file; null:
// those of the file. A joint's name in a BVH file ends with its line or before a brace.
function parseBvh(text, rate = null) {
  text = text.replace(/^\ufeff/, "");
  if (!/^\s*HIERARCHY(?!\S)/.test(text)) throw new Error("not a BVH file: expected HIERARCHY first");
  const found = /(?<!\S)MOTION\s+Frames:\s*(\S+)\s+Frame\s+Time:\s*(\S+)/.exec(text);
  const joints = bvhJoints(text.slice(text.indexOf("HIERARCHY") + 9, found ? found.index : text.length));
  if (!found) throw new Error("cut short, or damaged: expected MOTION, Frames: and Frame Time: after the joints");
  const count = bvhNumber(found[1]), seconds = rate === null ? bvhNumber(found[2]) : 1 / rate;
  const width = joints.reduce((sum, j) => sum + j.channels.length, 0);
  const expected = `expected at least one frame and a positive Frame Time, got ${found[1]} and ${found[2]}`;
  if (!(count >= 1 && Number.isInteger(count))) throw new Error(expected);
  if (!(seconds > 0 && Number.isFinite(1 / seconds))) throw rateError(expected);
  const words = text.slice(found.index + found[0].length).split(/\s+/).filter(Boolean);
  const rows = words.length / width, short = words.length < count * width ? ": cut short?" : "";
  if (width === 0 || !(rows >= 1 && Number.isInteger(rows)))
    throw new Error(`expected ${count} frames of ${width} numbers, got ${words.length} numbers${short}`);
  const note = rows === count ? "" : `the file says ${count} frames, but has ${rows}: these are taken`;
  const frames = Array.from({ length: rows }, (_, f) => words.slice(f * width, (f + 1) * width).map(bvhNumber));
  const place = joints.map(() => [0, 0, 0]);  // parents stand before their children
  joints.forEach((joint, i) => { place[i] = joint.parent < 0 ? [0, 0, 0] : add(place[joint.parent], joint.offset); });
  const added = positionsAreAdded(joints, frames);
  return { joints, place, own: frames.map((numbers) => poseBvh(joints, numbers, added)), fps: 1 / seconds, up: null, note };
}

// Returns whether the positions of the joints below the root are added to their offsets, as in
// files of MakeHuman, and do not replace them.
function positionsAreAdded(joints, frames) {
  let at = 0, moving = 0, own = 0, apart = 0;
  for (const joint of joints) {
    const places = joint.channels.map((channel, i) => [channel, at + i]).filter(([channel]) => channel.endsWith("position"));
    at += joint.channels.length;
    if (joint.parent < 0 || !places.length) continue;
    moving++;
    for (const [channel, column] of places) {
      const offset = joint.offset["xyz".indexOf(channel[0])];
      for (const numbers of frames) {
        own += Math.abs(numbers[column]);
        apart += Math.abs(numbers[column] - offset);
      }
    }
  }
  return moving > joints.length / 2 && own < apart;
}

function bvhNumber(word) {
  const value = /^[-+.\deE]+$/.test(word) ? Number(word) : NaN;
  if (!Number.isFinite(value)) throw new Error(`expected a number, got ${word}`);
  return value;
}

// Returns the joints, parents first, without the ends of limbs.
function bvhJoints(text) {
  const words = text.matchAll(/(ROOT|JOINT|End)\s+([^\r\n{}]*)|[{}]|[^\s{}]+/g), joints = [], open = [];
  let waiting = null;
  const word = () => {
    const { value, done } = words.next();
    if (done) throw new Error("cut short");
    return value[0];
  };
  for (const [whole, kind, name] of words) {
    const here = open.at(-1) ?? null;  // null for the end of a limb
    if (kind) waiting = { end: kind === "End", name: name.split(/\s+/).filter(Boolean).join(" ") };
    else if (whole === "{" && waiting) {
      open.push(waiting.end ? null : joints.length);
      if (!waiting.end) joints.push({ name: waiting.name, parent: here ?? -1, channels: [], offset: [0, 0, 0] });
      waiting = null;
    } else if (whole === "}" && open.length) open.pop();
    else if (whole === "OFFSET" && open.length) {
      const offset = [0, 1, 2].map(() => bvhNumber(word()));
      if (here !== null) joints[here].offset = offset;
    } else if (whole === "CHANNELS" && here !== null) {
      const amount = bvhNumber(word()), channels = Array.from({ length: Math.min(Math.max(amount, 0), 7) }, () => word().toLowerCase());
      if (channels.length !== amount || !channels.every((channel) => CHANNELS.includes(channel)))
        throw new Error(`joint ${joints[here].name}: expected up to 6 channels such as Xrotation`);
      joints[here].channels = channels;
    } else throw new Error(`unknown word ${whole}`);
  }
  if (open.length || waiting || !joints.length) throw new Error(joints.length ? "cut short: a brace of the joints is open" : "cut short: no joints");
  if (joints.filter(({ parent }) => parent < 0).length !== 1) throw new Error("expected one ROOT");
  return joints;
}

// Returns a Map from our joints to indices of the file's joints, for those that the file has, as
// humangs_jax/motion/matching.py does. place, posed: joints in the rest pose and in the first
// frame.
function matchJoints(joints, scene, place, posed) {
  const parents = joints.map((j) => j.parent), plain = plainNames(joints.map((j) => j.name));
  let source = namedJoints(plain);
  if (source.has("left_hip") && source.has("right_hip")) {
    const [one, two] = ["left_hip", "right_hip"].map((name) => ancestors(parents, source.get(name)).slice(1));
    const common = one.filter((joint) => two.includes(joint));
    if (common.length && !common.includes(source.get("pelvis"))) source.set("pelvis", common[0]);
  }
  const missing = RULES.NEEDED.filter((name) => !source.has(name));
  if (missing.length || !descends(source, parents)) {
    const limbs = limbsOfTree(plain, parents, place, posed);
    if (!limbs) {
      const what = missing.length ? `no joint for ${missing.join(", ")}` : "joints that do not hang below each other";
      throw new Error(`${what}: ${RULES.EXPECTED_NAMES}, got ${joints.slice(0, 12).map((j) => j.name).join(", ")}`);
    }
    const body = ["pelvis", "neck", "head"];
    for (const side of RULES.SIDES) for (const name of ["collar", ...RULES.UNDER.flat()]) body.push(`${side}_${name}`);
    source = new Map([...[...source].filter(([name]) => !body.includes(name)), ...limbs]);
  }
  matchToes(source, parents, place);
  matchHead(source, plain, parents);
  matchSpine(joints, source);
  return new Map([...source].filter(([name]) => scene.names.includes(name)));
}

// Returns names as lower-case letters and digits, without prefixes that all or many of them share.
function plainNames(names) {
  const plain = names.map((name) => {
    name = name.replace(/^.*[:|]/, "").toLowerCase().replace(/(finger\d)-(?=\d)/, `$1${RULES.FINGER_JOINT}`);
    const words = (!name.startsWith("__") && name.match(/[a-z0-9]+/g)) || [];
    return words.filter((word) => !RULES.NOISE.includes(word)).join("").replace(/^mixamorig\d*/, "");
  });
  const filled = plain.filter(Boolean);
  let start = 0;
  while (filled.length >= RULES.FEW && filled[0][start] !== undefined && filled.every((name) => name[start] === filled[0][start])) start++;
  return plain.map((name) => name.slice(start));
}

function namedJoints(plain) {
  const source = new Map(), taken = new Set();
  const find = (ours, theirs) => {
    const found = theirs.map((name) => plain.indexOf(name)).find((i) => i >= 0 && !taken.has(i));
    if (found !== undefined) taken.add(found) && source.set(ours, found);
  };
  for (const [ours, theirs] of Object.entries(RULES.MIDDLE)) find(ours, theirs);
  for (const [ours, theirs] of Object.entries(RULES.SIDED))
    for (const side of RULES.SIDES) find(`${side}_${ours}`, theirs.flatMap((x) => [side + x, side[0] + x, x + side[0], x + side]));
  return source;
}

function ancestors(parents, joint) {
  const found = [];
  for (; joint >= 0; joint = parents[joint]) found.push(joint);
  return found;
}

const descends = (source, parents) => RULES.UNDER.every(([a, b]) => RULES.SIDES.every((side) => {
  const [above, below] = [source.get(`${side}_${a}`), source.get(`${side}_${b}`)];
  return above === undefined || below === undefined || ancestors(parents, below).slice(1).includes(above);
}));

// Finds the joints of arms, legs and pelvis from the shape of the tree. Returns entries of a Map,
// or null if it is not the tree of a person.
function limbsOfTree(plain, parents, place, posed) {
  const lengths = parents.map((p, i) => (p < 0 ? 0 : Math.hypot(...subtract(place[i], place[p]))));
  const children = parents.map((_, i) => parents.flatMap((p, j) => (p === i ? [j] : []))), reach = [...lengths];
  for (let i = parents.length - 1; i >= 0; i--) reach[i] += Math.max(0, ...children[i].map((child) => reach[child]));
  const bones = (limb) => [lengths[limb[1]], lengths[limb[2]]], total = (limb) => bones(limb)[0] + bones(limb)[1];
  const bends = (joint) => {
    const path = [joint];
    while (children[path.at(-1)].length) path.push(children[path.at(-1)].reduce((best, child) => (reach[child] > reach[best] ? child : best)));
    const inner = path.slice(1).map((j) => lengths[j]);
    if (inner.length < 2) return null;
    const shorter = inner.slice(1).map((x, i) => Math.min(x, inner[i])), first = shorter.indexOf(Math.max(...shorter));
    return inner[first] > 0 ? path.slice(first, first + 4) : null;
  };
  const alike = (a, b) => Math.max(...bones(a).map((x, i) => Math.abs(x - bones(b)[i]))) <= RULES.LIKE * Math.max(...bones(a), ...bones(b));
  const longest = (items, size) => items.reduce((best, item) => (best === null || size(item) > size(best) ? item : best), null);
  const found = parents.flatMap((_, joint) => {
    const limbs = children[joint].map(bends).filter(Boolean);
    const pairs = limbs.flatMap((a, i) => limbs.slice(0, i).filter((b) => alike(a, b)).map((b) => [a, b]));
    const pair = longest(pairs, ([a, b]) => total(a) + total(b));
    return pair ? [{ joint, pair }] : [];
  });
  for (const { joint: pelvis, pair: legs } of found) {
    const inside = found.filter(({ joint }) => {
      const above = ancestors(parents, joint);
      return above.slice(1).includes(pelvis) && !legs.some(([hip]) => above.includes(hip));
    });
    if (inside.length) {
      const { joint: chest, pair: arms } = longest(inside, ({ pair }) => total(pair[0]));
      return sidedLimbs(plain, parents, posed, pelvis, legs, chest, arms);
    }
  }
  return null;
}

function sidedLimbs(plain, parents, posed, pelvis, legs, chest, arms) {
  const toes = legs.filter((leg) => leg.length > 3).map((leg) => subtract(posed[leg[3]], posed[leg[2]]));
  const left = cross(normalized(subtract(posed[chest], posed[pelvis])), toes.length ? toes.reduce(add) : [0, 0, 1]);
  const source = [["pelvis", pelvis]];
  for (const [limbs, names] of [[legs, ["hip", "knee", "ankle", "foot"]], [arms, ["shoulder", "elbow", "wrist"]]]) {
    let sides = limbs.map((limb) => RULES.SIDES.find((side) => limb.slice(0, 3).every((j) => {
      const name = plain[j];
      return [side, side[0]].some((word) => name.startsWith(word) || name.endsWith(word));
    })));
    if (!RULES.SIDES.every((side) => sides.includes(side)))
      sides = dot(posed[limbs[0][0]], left) > dot(posed[limbs[1][0]], left) ? ["left", "right"] : ["right", "left"];
    limbs.forEach((limb, i) => {
      names.slice(0, limb.length).forEach((name, k) => source.push([`${sides[i]}_${name}`, limb[k]]));
      const above = parents[limb[0]];
      if (limbs === arms && above !== chest) source.push([`${sides[i]}_collar`, above]);
    });
  }
  return source;
}

function matchToes(source, parents, place) {
  for (const side of RULES.SIDES) {
    const ankle = source.get(`${side}_ankle`), far = (i) => Math.hypot(...subtract(place[i], place[ankle]));
    const below = parents.flatMap((p, i) => (p === ankle && far(i) > 0 ? [i] : []));
    if (!source.has(`${side}_foot`) && below.length) source.set(`${side}_foot`, below.reduce((best, i) => (far(i) > far(best) ? i : best)));
  }
}

// Finds neck and head in the chain between the arms: its first joint is the neck, its last one the
// head, apart from ends of bones.
function matchHead(source, plain, parents) {
  if (source.has("neck") || source.has("head")) return;
  const arms = RULES.SIDES.map((side) => ancestors(parents, source.get(`${side}_shoulder`)).slice(1));
  const chest = arms[0].find((joint) => arms[1].includes(joint)), used = new Set(source.values()), chains = [];
  parents.forEach((p, i) => {
    if (p !== chest || arms.some((arm) => arm.includes(i)) || used.has(i)) return;
    const chain = [i], below = (joint) => parents.flatMap((q, j) => (q === joint ? [j] : []));
    for (let next = below(i); next.length === 1; next = below(next[0])) chain.push(next[0]);
    while (chain.length > 1 && RULES.ENDS.some((end) => plain[chain.at(-1)].endsWith(end))) chain.pop();
    chains.push(chain);
  });
  if (!chains.length) return;
  const chain = chains.reduce((best, each) => (each.length > best.length ? each : best));
  source.set("neck", chain[0]);
  if (chain.length > 1) source.set("head", chain.at(-1));
}

// Matches the spine, which has one to five joints with various names. Ours are the first, the
// middle and the last joint of the file's spine.
function matchSpine(joints, source) {
  const found = [];
  let at = joints[source.get("neck") ?? source.get("head")]?.parent ?? -1;
  for (; at >= 0 && at !== source.get("pelvis"); at = joints[at].parent) found.unshift(at);
  const last = found.length - 1, ours = { spine3: last, spine1: last > 0 ? 0 : -1, spine2: last > 1 ? last >> 1 : -1 };
  for (const [name, i] of Object.entries(ours)) if (at >= 0 && i >= 0) source.set(name, found[i]);
}

const transposed = (m) => [0, 3, 6, 1, 4, 7, 2, 5, 8].map((i) => m[i]);

// Converts a clip to our joints, so that our bones point where the file's bones point. The rest
// frames of a joint are related by the rotation that turns our rest direction into the file's. It
// is carried down from the pelvis, whose rotation is fixed by the line of the hips and the up
// direction of the spine. If nobody can stand in the rest pose, twists are set to 0 on average over
// the frames.
function retargeted(clip, scene) {
  const lacking = RULES.NEEDED.filter((name) => !scene.names.includes(name));
  if (lacking.length)
    throw new Error(`skeletons move bodies of SMPL-X's joints, this avatar has no ${lacking.join(", ")}`);
  const { place, own } = clip, source = matchJoints(clip.joints, scene, place, own[0].position);
  const between = (a, b) => subtract(place[source.get(b)], place[source.get(a)]), theirs = (a, b) => normalized(between(a, b));
  const rest = (name) => scene.rest[scene.names.indexOf(name)];
  const top = RULES.TOPS.find((name) => source.has(name)), spine = theirs("pelvis", top), tall = nearestAxis(spine).axis;
  const standing = dot(normalized(add(between("left_hip", "left_ankle"), between("right_hip", "right_ankle"))), spine) < RULES.STANDING;
  const legs = (at) => ["left_hip>left_knee", "left_knee>left_ankle"].reduce((sum, pair) => {
    const [a, b] = pair.split(">");
    return sum + Math.hypot(...subtract(at(b), at(a)));
  }, 0);
  const scale = legs(rest) / Math.max(legs((name) => own[0].position[source.get(name)]), 1e-9);  // units, and the length of the steps
  const usual = standing ? tall : "y", known = { up: clip.up, note: "" };
  const found = clip.up ? known : upOfClip(own, source, top, scale, usual, clip.fps);
  const upright = uprightMatrix(found.up);
  const posed = own.map(({ world, position }) => (
    { world: world.map((m) => matrixMultiply(upright, m)), position: position.map((p) => matrixApply(upright, p)) }
  ));

  const frameOf = (right, up) => {
    const x = normalized(right), z = normalized(cross(x, up)), y = cross(z, x);
    return [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];
  };
  const root = matrixMultiply(
    frameOf(theirs("right_hip", "left_hip"), spine),
    transposed(frameOf(subtract(rest("left_hip"), rest("right_hip")), subtract(rest(top), rest("pelvis")))),
  );
  const pelvis = pelvisTurns(clip.joints, source, place, posed, top);
  const align = [], global = posed.map(() => []);  // our rest frame -> the file's rest frame; our joints in the world
  for (const j of scene.order) {
    const name = scene.names[j], p = scene.parents[j], at = source.get(name);
    const child = p < 0 ? undefined : (NEXT.get(name) || []).find((other) => source.has(other));
    align[j] = p < 0 ? root : align[p];
    if (!standing && at !== undefined && child === undefined && name.endsWith("_ankle"))  // no toes: as in T-pose on average
      align[j] = transposed(meanTurn(posed.map(({ world }, f) => matrixMultiply(transposed(global[f][p]), world[at]))));
    if (at === undefined || child === undefined) {  // joints that the file does not have go with their parents
      posed.forEach(({ world }, f) => {
        global[f][j] = p < 0 ? matrixMultiply(pelvis[f], root) : at === undefined ? global[f][p] : matrixMultiply(world[at], align[j]);
      });
      continue;
    }
    const bone = normalized(subtract(rest(child), rest(name)));
    align[j] = matrixMultiply(smallestTurn(matrixApply(align[j], bone), theirs(name, child)), align[j]);
    if (!standing) {
      const turns = posed.map(({ world }, f) => matrixMultiply(transposed(global[f][p]), matrixMultiply(world[at], align[j])));
      align[j] = matrixMultiply(align[j], untwist(turns, bone));
    }
    posed.forEach(({ world, position }, f) => {
      const turned = matrixMultiply(world[at], align[j]), direction = normalized(subtract(position[source.get(child)], position[at]));
      global[f][j] = matrixMultiply(smallestTurn(matrixApply(turned, bone), direction), turned);
    });
  }

  const quats = global.map((frame) => frame.map((m, j) => quatFromMatrix(scene.parents[j] < 0 ? m : matrixMultiply(transposed(frame[scene.parents[j]]), m))));
  const moves = posed.map(({ position }) => scaled(position[source.get("pelvis")], scale));
  const restScale = legs(rest) / Math.max(legs((name) => place[source.get(name)]), 1e-9);
  const low = standing ? soles(place, source, uprightMatrix(tall), restScale) : null;
  const steps = stepsOf(posed, source, scale, low), ofBody = stepsOfBody(global, scene, source, moves);
  const translations = moves.map((move, f) => subtract(add(move, [0, steps[f] - ofBody[f], 0]), rest("pelvis")));
  const whole = Math.round(clip.fps);  // BVH has 0.0083333 for 120
  const fps = Math.abs(clip.fps - whole) < RULES.RATE_ROUNDING * clip.fps ? whole : clip.fps;
  return { quats, translations, fps, clips: clip.names, note: [clip.note, found.note].filter(Boolean).join("; ") };
}

const NEXT = new Map(Object.entries(RULES.NEXT));

// Returns { up, note }. BVH does not say which axis is up, but a rest pose in which people stand
// shows it.
function upOfClip(posed, source, top, scale, usual, fps) {
  const trunks = posed.map(({ position }) => normalized(subtract(position[source.get(top)], position[source.get("pelvis")])));
  const { axis, cosine } = nearestAxis([0, 1, 2].map((i) => mean(trunks.map((v) => v[i]))));
  if (!(cosine >= RULES.CLEARLY_UP) || axis === usual) return { up: usual, note: "" };
  const used = [...source.values()].sort((a, b) => a - b);
  const points = sampledFrames(posed.length).map((f) => used.map((i) => scaled(posed[f].position[i], scale)));
  return upAxis(points, axis, usual, fps, []);
}

// Returns the rotations of the pelvis from the rest pose to the frames. They are those of the
// joint, or of the joints that carry the hips if these agree better with the trunk, turned so that
// the line of the hips is the file's.
function pelvisTurns(joints, source, place, posed, top) {
  const [pelvis, left, right] = ["pelvis", "left_hip", "right_hip"].map((name) => source.get(name)), end = source.get(top);
  const restLine = subtract(place[left], place[right]), above = joints[left].parent, beside = joints[right].parent;
  const lines = posed.map(({ position }) => normalized(subtract(position[left], position[right])));
  const meeting = (turn, f) => matrixMultiply(smallestTurn(normalized(matrixApply(turn, restLine)), lines[f]), turn);
  // angles about the line of the hips between two directions of a joint above: that of the rest
  // pose, turned, and that of the frame
  const tilts = (turns, joint) => turns.map((turn, f) => {
    const across = (v) => subtract(v, scaled(lines[f], dot(v, lines[f])));
    const a = across(matrixApply(turn, subtract(place[joint], place[pelvis])));
    const b = across(subtract(posed[f].position[joint], posed[f].position[pelvis]));
    return Math.atan2(dot(cross(a, b), lines[f]), dot(a, b));
  });
  const size = (angles) => mean(angles.map(Math.abs)), own = posed.map(({ world }, f) => meeting(world[pelvis], f));
  if (above >= 0 && beside >= 0 && !(above === pelvis && beside === pelvis)) {
    const halfway = ({ world }) => matrixFromQuat(quatSlerp(quatFromMatrix(world[above]), quatFromMatrix(world[beside]), 0.5));
    const other = posed.map((frame, f) => meeting(halfway(frame), f));
    return size(tilts(other, end)) < size(tilts(own, end)) - RULES.BETTER_TILT ? other : own;
  }
  const chain = [end];
  while (joints[chain[0]].parent >= 0 && joints[chain[0]].parent !== pelvis) chain.unshift(joints[chain[0]].parent);
  const far = (joint) => Math.hypot(...subtract(place[joint], place[pelvis]));
  const tilt = tilts(own, chain.find((joint) => far(joint) > 0.01 * far(end)) ?? end);
  if (size(tilt) <= RULES.LARGEST_BEND) return own;
  return own.map((turn, f) => matrixMultiply(matrixFromQuat(quatFromAxisAngle(...scaled(lines[f], tilt[f]))), turn));
}

function meanTurn(turns) {
  const quats = turns.map(quatFromMatrix), sum = [0, 0, 0, 0];
  for (const q of quats) q.forEach((v, i) => { sum[i] += q.reduce((d, x, k) => d + x * quats[0][k], 0) < 0 ? -v : v; });
  return matrixFromQuat(quatNormalize(sum));
}

// Returns the rotation about a bone that removes the mean twist about the bone from rotations. The
// twist of (w, v) about b is 2 arg(w + i v.b).
function untwist(turns, bone) {
  let real = 0, imaginary = 0;
  for (const m of turns) {
    const [w, ...v] = quatFromMatrix(m), along = dot(v, bone);
    real += w * w - along * along;
    imaginary += 2 * w * along;
  }
  return matrixFromQuat(quatFromAxisAngle(...scaled(bone, -Math.atan2(imaginary, real))));
}

const feetOf = (source) => RULES.FEET.map((kind) => kind.filter((name) => source.has(name))).filter((kind) => kind.length);

// Returns how high each joint of the file's feet is above the lowest of them, in a rest pose that
// stands.
function soles(place, source, upright, scale) {
  const names = feetOf(source).flat(), heights = names.map((name) => scale * matrixApply(upright, place[source.get(name)])[1]);
  return new Map(names.map((name, i) => [name, heights[i] - Math.min(...heights)]));
}

// Returns how high the feet are above the floor in each frame. The floor is where feet are lowest.
// low: height of each joint of the feet when the foot stands; null: each kind of joint has the
// height of its lowest frame.
function stepsOf(posed, source, scale, low) {
  const height = ({ position }, name) => scale * position[source.get(name)][1];
  if (!low) {
    low = new Map();
    for (const kind of feetOf(source)) {
      const lowest = least(posed.map((frame) => Math.min(...kind.map((name) => height(frame, name)))));
      for (const name of kind) low.set(name, lowest);
    }
  }
  const feet = posed.map((frame) => Math.min(...[...low].map(([name, sole]) => height(frame, name) - sole)));
  const floor = least(feet);
  return feet.map((y) => y - floor);
}

// Returns the same heights for our body, above a floor at the height of its lowest joint in T-pose.
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

// Returns rotations and places of all joints in the world.
function poseBvh(joints, numbers, added) {
  const axes = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] }, world = [], position = [];
  let at = 0;
  joints.forEach((joint, i) => {
    let local = [1, 0, 0, 0];
    const move = [...joint.offset];
    for (const channel of joint.channels) {
      const value = numbers[at++], axis = channel[0];
      if (channel.endsWith("position")) move["xyz".indexOf(axis)] = value + (added && joint.parent >= 0 ? joint.offset["xyz".indexOf(axis)] : 0);
      else local = quatMultiply(local, quatFromAxisAngle(...scaled(axes[axis], value * Math.PI / 180)));
    }
    const m = matrixFromQuat(local), p = joint.parent;
    world[i] = p < 0 ? m : matrixMultiply(world[p], m);
    position[i] = p < 0 ? move : add(position[p], matrixApply(world[p], move));
  });
  return { world, position };
}

// Returns the matrix that turns one unit vector into another by the smallest angle. It is the
// identity if they are equal.
function smallestTurn(from, to) {
  const c = dot(from, to), side = () => normalized(cross(from, Math.abs(from[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  return matrixFromQuat(c < -0.999999 ? [0, ...side()] : quatNormalize([1 + c, ...cross(from, to)]));
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
