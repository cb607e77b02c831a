// The state, the loop that draws when something has changed, and `window.humangs`, with which tests
// set exact views.

const LEAST_FRAME_MS = 45;   // slower than this, the resolution falls while things move
const QUALITIES = [1, 0.75, 0.5];
const STILL_MS = 250;        // after so long without a change the image is drawn at full resolution
const LARGEST_PICTURE = 2 ** 24;  // pixels; some browsers make no more
const PHONE = 640;           // pixels; as in style.css: the panel lies below
const FOLLOW_SECONDS = 0.4;  // the camera follows the mean of the path over so long before and after

async function start() {
  document.body.classList.remove("unable");  // this browser reads the page's scripts
  if (typeof DecompressionStream === "undefined") throw new Error("DecompressionStream is missing.");
  const scene = await readScene();
  applyFace(scene, null);
  const canvas = element("view"), renderer = makeRenderer(canvas, scene);
  const distance = (0.54 * scene.height) / Math.tan(FIELD_OF_VIEW / 2) + 0.3 * scene.height;
  const orbit = makeOrbit([0, 0.5 * scene.height, 0], distance), home = { ...orbit };
  const app = {
    scene, orbit, mode: scene.motion ? "motion" : "a", motionName: scene.header.motion?.name, frame: 0, playing: Boolean(scene.motion), speed: 1,
    degrees: scene.names.map(() => [0, 0, 0]), expression: new Float32Array(scene.header.face?.names.length ?? 0), idle: null, betas: scene.header.shape ? [...scene.header.shape.betas] : [],
    follow: true, look: { background: [1, 1, 1], transparent: false, ground: 1 },
    invalidate, setMode, setPlaying, setFrame, stepFrame, setShape, setMotion, framePerson, picture, setRecording,
  };
  const still = { rest: restPose(scene.names.length), a: aPose(scene.names) };
  const hasFeet = ["left_foot", "right_foot"].map((name) => scene.names.indexOf(name)).filter((j) => j >= 0);

  // ---- depth order: in a worker, so that the page stays responsive ----
  const sorter = makeSorter(scene.count, scene.means, scene.arrays.weight_joints, scene.arrays.weights);
  const worker = startWorker(scene);
  let spare = new Uint32Array(scene.count), sorted = null, sorting = null;
  if (worker) worker.onmessage = ({ data }) => {
    renderer.setOrder(data.order);
    [spare, sorted, sorting] = [data.order, sorting, null];
    if (!exact) draw();
  };
  function sortFor(rows, now) {
    if (sorted && sorted.every((v, i) => v === rows[i])) return;
    if (worker && !now) {
      if (sorting) return;  // the next image asks again
      sorting = rows;
      worker.postMessage({ rows, order: spare }, [spare.buffer]);
      return;
    }
    renderer.setOrder(sorter.sort(rows, new Uint32Array(scene.count)));
    sorted = rows;
  }

  // ---- one image ----
  let exact = null, quality = 0, recordedSize = null, lastDrawn = { camera: null, pose: null };

  function currentPose() {
    const base = app.mode === "motion" && scene.motion ? motionPose(scene.motion, app.frame) : still[app.mode === "rest" ? "rest" : "a"];
    const translation = base === still.rest || base === still.a ? [0, -scene.floor, 0] : base.translation;
    const quats = base.quats.map((q, j) => {
      const d = app.degrees[j];
      return d[0] || d[1] || d[2] ? quatMultiply(q, quatFromAxisAngle(...scaled(d, Math.PI / 180))) : q;
    });
    return { quats, translation };
  }

  const fullRatio = () => Math.min(devicePixelRatio || 1, 2);
  const sizeAt = (ratio) => [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));

  function currentCamera() {
    if (recordedSize) return orbitCamera(orbit, ...recordedSize, followed());
    const ratio = fullRatio() * QUALITIES[quality], [width, height] = sizeAt(ratio);
    const panel = element("panel"), bar = element("transport"), below = bar.offsetHeight && bar.offsetHeight + 14;
    const [right, bottom] = innerWidth > PHONE ? [panel.offsetWidth && panel.offsetWidth + 14, below]
      : [0, panel.offsetHeight ? panel.offsetHeight + 68 : below];
    return orbitCamera(orbit, width, height, followed(), right * ratio, bottom * ratio);
  }

  function followed() {
    if (!(app.follow && app.mode === "motion" && scene.motion)) return [0, 0, 0];
    const { translations, fps } = scene.motion, half = Math.max(1, Math.round(FOLLOW_SECONDS * fps));
    const mean = (f) => {
      let x = 0, z = 0, n = 0;
      for (let i = Math.max(0, f - half); i <= Math.min(translations.length - 1, f + half); i++, n++) {
        x += translations[i][0];
        z += translations[i][2];
      }
      return [x / n, z / n];
    };
    const first = Math.min(Math.floor(app.frame), translations.length - 1), a = mean(first);
    const b = mean(Math.min(first + 1, translations.length - 1)), t = app.frame - first;
    return [a[0] + t * (b[0] - a[0]), 0, a[1] + t * (b[1] - a[1])];
  }

  function currentFace() {
    if (!scene.header.face) return null;
    const moving = app.mode === "motion" ? motionFace(scene.motion, app.frame) : null;
    const idle = !moving && app.idle?.on ? app.idle.coefficients() : null;
    return app.expression.map((x, e) => x + (moving?.[e] ?? 0) + (idle?.[e] ?? 0));
  }

  function makeFace(coefficients) {
    if (!applyFace(scene, coefficients)) return;
    renderer.setMeans();
    sorter.setMeans(scene.means);
    worker?.postMessage({ means: scene.means });
  }

  function drawPose(camera, pose, look, now) {
    const { rows, joints } = poseJoints(scene.rest, scene.parents, scene.order, pose.quats, pose.translation);
    const [a, b, c] = camera.rotation.slice(6), depthRows = new Float32Array(4 * scene.parents.length);
    for (let j = 0; j < scene.parents.length; j++)
      for (let k = 0; k < 4; k++) depthRows[4 * j + k] = a * rows[12 * j + k] + b * rows[12 * j + 4 + k] + c * rows[12 * j + 8 + k];
    sortFor(depthRows, now || !sorted);
    const shadow = (joint, strength) => [joint[0], joint[2], strength * Math.exp(-Math.max(0, joint[1]) * 2.5)];
    const root = joints[scene.order[0]], shadows = hasFeet.map((j) => shadow(joints[j], 1));
    shadows.push([root[0], root[2], 0.55]);
    while (shadows.length < 3) shadows.push([0, 0, 0]);
    renderer.render(camera, rows, { ...look, floor: 0, shadows, middle: [root[0], root[2]] });
    lastDrawn = { camera, pose };
  }

  function draw() {
    const look = recordedSize ? { ...app.look, transparent: false } : app.look;  // videos have no transparency
    makeFace(currentFace());
    drawPose(currentCamera(), currentPose(), look, false);
  }
  function drawFull() {
    const reduced = quality;
    quality = 0;
    draw();
    quality = reduced;
  }

  // ---- the loop ----
  let scheduled = false, lastTime = null, frameMs = 0, stillTimer = 0;
  function invalidate() {
    if (exact || scheduled) return;
    scheduled = true;
    requestAnimationFrame(tick);
  }
  function tick(time) {
    scheduled = false;
    if (exact) return;
    const moving = app.playing && app.mode === "motion" && scene.motion, since = lastTime === null ? 0 : time - lastTime;
    if (moving) {
      const count = scene.motion.quats.length;
      app.frame += (Math.min(since, 250) / 1000) * scene.motion.fps * app.speed;
      if (app.frame > count - 1) app.frame = count > 1 ? app.frame % (count - 1) : 0;
    }
    if (since > 0 && since < 1000) frameMs = frameMs ? frameMs + 0.12 * (since - frameMs) : since;
    lastTime = time;
    draw();
    controls.update();
    controls.showRate(frameMs ? 1000 / frameMs : 0, true);
    adapt();
    clearTimeout(stillTimer);
    if (moving || recordedSize) invalidate();
    else stillTimer = setTimeout(stand, STILL_MS);
  }
  let slow = 0;
  function adapt() {
    slow = frameMs > LEAST_FRAME_MS ? slow + 1 : 0;
    if (slow > 12 && quality < QUALITIES.length - 1) {
      quality++;
      slow = 0;
    }
  }
  function stand() {
    controls.showRate(frameMs ? 1000 / frameMs : 0, false);
    lastTime = null;
    frameMs = 0;
    if (quality > 0 && !exact) drawFull();
  }

  // ---- what controls do ----
  function setMode(mode) {
    if (mode === "motion" && !scene.motion) return;
    app.mode = mode;
    invalidate();
  }
  function setPlaying(playing) {
    app.playing = playing && Boolean(scene.motion);
    if (app.playing) app.mode = "motion";
    lastTime = null;
    invalidate();
  }
  function setFrame(frame) {
    app.frame = Math.max(0, Math.min(frame, scene.motion.quats.length - 1));
    invalidate();
  }
  function stepFrame(by) {
    if (!scene.motion) return;
    const count = scene.motion.quats.length;
    app.mode = "motion";
    setPlaying(false);
    setFrame((Math.round(app.frame) + by + count) % count);
  }
  function setShape(betas) {
    app.betas = betas;
    applyShape(scene, betas);
    applyFace(scene, currentFace());
    renderer.setMeans();
    sorter.setMeans(scene.means);
    worker?.postMessage({ means: scene.means });
    sorted = null;
    invalidate();
  }
  function setMotion(motion, name) {
    scene.motion = groundedMotion(motion, scene.rest, scene.parents, scene.order, scene.soleBelowJoint);
    [app.motionName, app.frame] = [name, 0];
    setPlaying(true);
  }
  function framePerson() {
    Object.assign(orbit, home, { target: [...home.target] });
    invalidate();
  }
  // Returns { blob, width, height } of a PNG of what is on the screen. The person is in the middle
  // and at full resolution, even while the screen has a lower one. transparent: the person alone.
  async function picture(scale, transparent) {
    const { clientWidth, clientHeight } = canvas, most = Math.sqrt(LARGEST_PICTURE / (clientWidth * clientHeight));
    const longest = renderer.longestSide / Math.max(clientWidth, clientHeight);
    const [width, height] = sizeAt(Math.min(fullRatio() * scale, longest, most));
    const look = transparent ? { ...app.look, transparent, ground: 0 } : app.look;
    drawPose(orbitCamera(orbit, width, height, followed()), currentPose(), look, true);
    const encoded = new Promise((resolve) => canvas.toBlob(resolve));  // of the pixels as they are now
    if (app.playing) draw();
    else drawFull();
    return { blob: await encoded, width, height };
  }
  // Begins or ends a recording. Meanwhile controls are hidden, and the canvas keeps its size, whose
  // sides are even because encoders need that.
  function setRecording(recording) {
    recordedSize = recording ? sizeAt(fullRatio()).map((length) => length + (length % 2)) : null;
    document.body.classList.toggle("recording", recording);
    if (recording) draw();
    if (recording && app.mode === "motion") setPlaying(true);
    invalidate();
  }

  if (scene.header.face) app.idle = makeIdle(scene.header.face, invalidate);
  const controls = makeControls(app);
  makeSaving(app, canvas);
  applyOptions(app, controls, location.search);
  app.steer = steerOrbit(orbit, canvas, invalidate, framePerson);
  new ResizeObserver(invalidate).observe(canvas);
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); location.reload(); });
  draw();
  renderer.finish();
  const firstImage = performance.now();
  controls.update();
  invalidate();

  // ---- for tests ----
  const nested = (flat, width) => Array.from({ length: flat.length / width }, (_, i) => flat.slice(width * i, width * i + width));
  function exactPose({ rotations, translation, frame }) {
    if (frame !== undefined) return motionPose(scene.motion, frame);
    if (!rotations) return restPose(scene.names.length);
    return { quats: rotations.map((r) => quatFromAxisAngle(...r)), translation: translation || [0, 0, 0] };
  }
  return {
    state: () => ({ orbit: { ...orbit }, mode: app.mode, frame: app.frame, playing: app.playing }),
    restore(kept) {
      Object.assign(orbit, kept.orbit);
      setPlaying(kept.playing);
      setMode(kept.mode);
      if (scene.motion) setFrame(kept.frame);
    },
    firstImage, floats: renderer.floats, gaussians: scene.count - (scene.header.face?.hidden ?? 0),
    // Draws one image at once, with nothing but the person. view: { K, cam_from_world, width,
    // height }, a pose { rotations, translation } or { frame }, and a background. `resume` goes
    // back to the page.
    draw(view) {
      exact = exactCamera(view);
      makeFace(view.expression ?? null);
      document.body.classList.add("exact");
      Object.assign(canvas.style, { width: `${view.width / devicePixelRatio}px`, height: `${view.height / devicePixelRatio}px` });
      drawPose(exact, exactPose(view), { background: view.background || [1, 1, 1], ground: 0 }, true);
      renderer.finish();
    },
    resume() {
      exact = null;
      document.body.classList.remove("exact");
      Object.assign(canvas.style, { width: "", height: "" });
      invalidate();
    },
    // Returns camera and pose of the image on the screen, as Python takes them.
    view() {
      const { camera, pose } = lastDrawn, [fx, fy, cx, cy] = camera.K, { rotation: r, translation: t } = camera;
      return {
        K: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        cam_from_world: [...nested(r, 3).map((row, i) => [...row, t[i]]), [0, 0, 0, 1]], width: camera.width, height: camera.height,
        rotations: pose.quats.map(axisAngleFromQuat), translation: pose.translation, betas: app.betas,
        expression: currentFace(), frame: app.frame, mode: app.mode, playing: app.playing, background: app.look.background,
      };
    },
    // Plays `frames` images of the motion, one after the other, and resolves with the number of
    // images per second.
    async play(frames) {
      setPlaying(true);
      const began = performance.now();
      for (let i = 0; i < frames; i++) {
        await new Promise(requestAnimationFrame);
        renderer.finish();
      }
      const fps = 1000 * frames / (performance.now() - began);
      setPlaying(false);
      return fps;
    },
    // Pauses, and resolves when the image on the screen is final: at full resolution, and sorted
    // for its view.
    async settle() {
      setPlaying(false);
      app.idle?.set(false);
      const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
      do await wait(STILL_MS + 100); while (scheduled || sorting);
      quality = 0;
      draw();
      while (sorting) await wait(20);
      renderer.finish();
    },
    // Draws the motion from a turning camera without waiting for the screen. Returns images per
    // second, and milliseconds of one sort.
    benchmark({ frames = 60, width = 512, height = 512 }) {
      const rows = [];
      let began = 0;
      exact = {};
      for (let i = -5; i < frames; i++) {  // the first five are not timed
        if (i === 0) began = performance.now();
        const camera = orbitCamera({ ...home, azimuth: 0.1 * i }, width, height, [0, 0, 0]);
        const at = scene.motion ? motionPose(scene.motion, (i + 5) % scene.motion.quats.length) : still.a;
        drawPose(camera, at, { background: [1, 1, 1], ground: 0 }, true);
        renderer.finish();
      }
      const fps = 1000 * frames / (performance.now() - began);
      const order = new Uint32Array(scene.count), depthRows = sorted;
      began = performance.now();
      for (let i = 0; i < 20; i++) sorter.sort(depthRows, order);
      exact = null;
      invalidate();
      return { fps, sort_ms: (performance.now() - began) / 20 };
    },
  };
}

// Starts the worker that sorts. Returns null where pages may not start workers (some notebooks);
// the page then sorts itself.
function startWorker(scene) {
  try {
    const url = URL.createObjectURL(new Blob([element("sorting").textContent], { type: "text/javascript" }));
    const worker = new Worker(url);
    worker.postMessage({ start: { count: scene.count, means: scene.means, joints: scene.arrays.weight_joints, weights: scene.arrays.weights } });
    return worker;
  } catch {
    return null;
  }
}

window.humangs = { ready: null };
window.humangs.ready = start().then(
  (hook) => { Object.assign(window.humangs, hook); return true; },
  (error) => {
    console.error(error);
    document.body.classList.add("unable", "certain");
    element("reason").textContent = error.message;
    throw error;
  },
);
window.humangs.ready.catch(() => {});
