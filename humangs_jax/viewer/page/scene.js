// The avatar as Python has packed it (humangs_jax/viewer/page.py): its arrays, and the textures
// that shaders read.

const TEXELS_PER_ROW = 3072;  // of the texture of Gaussians: 3 texels each
const ROW = 1024;             // Gaussians per row of both textures

async function readScene() {
  const header = JSON.parse(document.getElementById("header").textContent);
  const text = atob(document.getElementById("data").textContent.trim());
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const buffer = await inflate(packed, "gzip");
  const types = { "<u2": Uint16Array, "<i2": Int16Array, "|u1": Uint8Array, "|i1": Int8Array, "<f4": Float32Array };
  const arrays = {};
  for (const [name, { type, shape, offset }] of Object.entries(header.arrays))
    arrays[name] = new types[type](buffer, offset, shape.reduce((a, b) => a * b, 1));

  const count = header.count, means = new Float32Array(3 * count), { low, high } = header.means;
  for (let i = 0; i < 3 * count; i++) means[i] = low[i % 3] + (arrays.means[i] / 65535) * (high[i % 3] - low[i % 3]);
  const rest = rows3(arrays.rest_joints), [bottom, top] = header.rest_bounds;
  const lowestJoint = Math.min(...rest.map((joint) => joint[1]));
  return {
    header, arrays, count, means, rest, faceKey: null,
    canonicalMeans: means.slice(), shapedMeans: means.slice(), canonicalRest: rest,
    parents: header.parents, names: header.joint_names, order: jointOrder(header.parents),
    soleBelowJoint: lowestJoint - bottom[1], height: top[1] - bottom[1],
    center: scaled(add(bottom, top), 0.5), floor: bottom[1],
    motion: header.motion ? unpackMotion(header, arrays) : null,
  };
}

async function inflate(bytes, format) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format))).arrayBuffer();
}

const rows3 = (flat) => Array.from({ length: flat.length / 3 }, (_, i) => [...flat.subarray(3 * i, 3 * i + 3)]);

function unpackMotion(header, arrays) {
  const { frames, fps, step } = header.motion, joints = header.parents.length, quats = [];
  for (let f = 0; f < frames; f++)
    quats.push(Array.from({ length: joints }, (_, j) => {
      const at = 3 * (f * joints + j), r = arrays.rotations;
      return quatFromAxisAngle(r[at] * step, r[at + 1] * step, r[at + 2] * step);
    }));
  const values = arrays.motion_faces, names = header.face?.names.length ?? 0;
  const faces = values && Array.from({ length: frames }, (_, f) =>
    Float32Array.from(values.subarray(names * f, names * (f + 1)), (v) => v * header.motion.face_step));
  return { quats, translations: rows3(arrays.translations), fps, faces: faces ?? null };
}

// Packs each Gaussian into three texels of four 32-bit numbers. project.frag unpacks them.
function gaussianTexels(scene) {
  const { arrays, count } = scene, height = Math.ceil(count / ROW), out = new Uint32Array(4 * TEXELS_PER_ROW * height);
  const { scales, quats, colors, opacities, weights, weight_joints: joints, light_shading: shading } = arrays;
  const pair = (a, b) => ((a & 0xffff) | (b << 16)) >>> 0;
  for (let i = 0; i < count; i++) {
    const t = 12 * i;
    out[t] = pair(scales[3 * i], scales[3 * i + 1]);
    out[t + 1] = pair(scales[3 * i + 2], opacities[i]);
    out[t + 2] = pair(quats[4 * i], quats[4 * i + 1]);
    out[t + 3] = pair(quats[4 * i + 2], quats[4 * i + 3]);
    out[t + 4] = pair(colors[3 * i], colors[3 * i + 1]);
    out[t + 5] = pair(colors[3 * i + 2], shading ? shading[i] : 0);
    for (let k = 0; k < 4; k++) {
      out[t + 6] |= joints[8 * i + k] << (8 * k);
      out[t + 7] |= joints[8 * i + 4 + k] << (8 * k);
      out[t + 8 + k] = pair(weights[8 * i + 2 * k], weights[8 * i + 2 * k + 1]);
    }
  }
  return { data: out, width: TEXELS_PER_ROW, height };
}

// Packs means, and the normals that light needs. The three 8-bit numbers of a normal become one
// whole number, which a float holds exactly.
function meanTexels(scene) {
  const height = Math.ceil(scene.count / ROW), out = new Float32Array(4 * ROW * height), n = scene.arrays.light_normals;
  for (let i = 0; i < scene.count; i++) {
    out.set(scene.means.subarray(3 * i, 3 * i + 3), 4 * i);
    if (n) out[4 * i + 3] = ((n[3 * i] + 127) << 16) | ((n[3 * i + 1] + 127) << 8) | (n[3 * i + 2] + 127);
  }
  return { data: out, width: ROW, height };
}

// Packs the colors that the direction of sight adds. Each function of the sphere has a block of
// rows like those of the means.
function harmonicTexels(scene) {
  const { harmonics } = scene.arrays, rows = Math.ceil(scene.count / ROW), { low, high } = scene.header.harmonics;
  const functions = harmonics.length / (3 * scene.count), out = new Float32Array(4 * ROW * rows * functions);
  for (let i = 0; i < scene.count; i++)
    for (let f = 0; f < functions; f++)
      for (let c = 0; c < 3; c++)
        out[4 * (f * rows * ROW + i) + c] = low + (harmonics[3 * (functions * i + f) + c] / 65535) * (high - low);
  return { data: out, width: ROW, height: rows * functions };
}

// Moves canonical means and joints for shape coefficients. The Gaussians of a vertex move with it
// and keep their sizes.
function applyShape(scene, betas) {
  const { shape } = scene.header, directions = scene.arrays.shape_directions, joints = scene.arrays.shape_joints;
  const j = scene.parents.length, vertices = directions.length / (3 * betas.length);
  const hidden = scene.header.face?.hidden ?? 0, first = scene.count - hidden, perVertex = first / vertices;
  const moved = new Float32Array(3 * vertices), rest = scene.canonicalRest.map((p) => [...p]);
  betas.forEach((beta, s) => {
    const change = beta - shape.betas[s];
    if (change === 0) return;
    for (let v = 0; v < 3 * vertices; v++) moved[v] += change * shape.step * directions[3 * vertices * s + v];
    for (let p = 0; p < 3 * j; p++) rest[(p / 3) | 0][p % 3] += change * joints[3 * j * s + p];
  });
  for (let i = 0; i < scene.count; i++) {
    const v = i < first ? Math.floor(i / perVertex) : scene.arrays.face_vertices[i - first];
    for (let c = 0; c < 3; c++) scene.means[3 * i + c] = scene.canonicalMeans[3 * i + c] + moved[3 * v + c];
  }
  scene.shapedMeans.set(scene.means);
  scene.faceKey = null;
  scene.rest = rest;
  const [bottom, top] = scene.header.rest_bounds;
  let low = 0, count = 0;  // the soles: the lowest 2 % of the body
  for (let i = 0; i < first; i++)
    if (scene.canonicalMeans[3 * i + 1] < bottom[1] + 0.02 * (top[1] - bottom[1])) {
      low += moved[3 * Math.floor(i / perVertex) + 1];
      count++;
    }
  scene.floor = bottom[1] + (count ? low / count : 0);
  scene.soleBelowJoint = Math.min(...rest.map((joint) => joint[1])) - scene.floor;
}
