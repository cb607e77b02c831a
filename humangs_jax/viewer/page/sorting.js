// Depth order of the posed Gaussians. This text runs twice: in the page, for exact views of tests
// and where workers are forbidden, and in a worker, which keeps the page responsive.

// Makes the functions that sort. means: Float32Array (3 g), canonical. joints: Uint8Array (8 g).
// weights: Uint16Array (8 g), largest first.
function makeSorter(count, means, joints, weights) {
  const BITS = 11, BUCKETS = 1 << BITS, LEVELS = (1 << (2 * BITS)) - 1;
  const HIDDEN_BELOW = -1000;  // metres; see AWAY in face.js
  const depths = new Float32Array(count), keys = new Uint32Array(count), half = new Uint32Array(count);
  const low = new Uint32Array(BUCKETS), high = new Uint32Array(BUCKETS);

  // Finds the depth of each Gaussian. The z of a blended mean in the camera is a blend of z, so one
  // row of four numbers per joint is enough.
  function findDepths(rows) {
    let near = Infinity, far = -Infinity;
    for (let i = 0; i < count; i++) {
      const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
      let a = 0, b = 0, c = 0, d = 0;
      for (let k = 8 * i; k < 8 * i + 8; k++) {
        const w = weights[k];
        if (w === 0) break;
        const row = 4 * joints[k];
        a += w * rows[row]; b += w * rows[row + 1]; c += w * rows[row + 2]; d += w * rows[row + 3];
      }
      const depth = a * x + b * y + c * z + d;
      depths[i] = depth;
      if (y < HIDDEN_BELOW) continue;  // far away so that nobody sees it: levels are for the others
      if (depth < near) near = depth;
      if (depth > far) far = depth;
    }
    return [near, far];
  }

  // Sorts by depth, nearest first, with a radix sort in 2^22 levels. For a person a level is less
  // than a micrometre.
  function sort(rows, order) {
    const [near, far] = findDepths(rows);
    const scale = LEVELS / Math.max(far - near, 1e-20);
    low.fill(0); high.fill(0);
    for (let i = 0; i < count; i++) {
      const key = Math.min(Math.max((depths[i] - near) * scale, 0), LEVELS) >>> 0;
      keys[i] = key;
      low[key & (BUCKETS - 1)]++;
      high[key >>> BITS]++;
    }
    for (let b = 0, l = 0, h = 0; b < BUCKETS; b++) {
      const nl = low[b], nh = high[b];
      low[b] = l; high[b] = h;
      l += nl; h += nh;
    }
    for (let i = 0; i < count; i++) half[low[keys[i] & (BUCKETS - 1)]++] = i;
    for (let n = 0; n < count; n++) {
      const i = half[n];
      order[high[keys[i] >>> BITS]++] = i;
    }
    return order;
  }

  return { sort, setMeans: (moved) => { means = moved; } };
}

if (typeof WorkerGlobalScope !== "undefined" && self instanceof WorkerGlobalScope) {
  let sorter = null;
  self.onmessage = ({ data }) => {
    if (data.start) sorter = makeSorter(data.start.count, data.start.means, data.start.joints, data.start.weights);
    if (data.means) sorter.setMeans(data.means);
    if (data.rows) self.postMessage({ order: sorter.sort(data.rows, data.order) }, [data.order.buffer]);
  };
}
