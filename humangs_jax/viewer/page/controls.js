// Everything that people click, drag or press. `app` (main.js) holds the state. Controls change the
// state and tell `app`.

const BACKGROUNDS = ["#f6f5f2", "#ffffff", "#c9d3dc", "#4c5158", "#15171a"];
// Names of the turns about x (to the left), y (up) and z (to the front) of the T-pose, by the
// direction of the bone.
const UPRIGHT_TURNS = ["bend", "turn", "lean"];
const ARM_TURNS = ["twist", "front, back", "up, down"];
const LEG_TURNS = ["front, back", "twist", "sideways"];
const FACE_TURNS = ["up, down", "left, right", "roll"];
const FINGER_TURNS = ["twist", "spread", "curl"];
const PLAIN_TURNS = ["turn", "turn", "turn"];
// Groups of sliders: title, joints, largest turn in degrees, and names of the turns.
const GROUPS = [
  ["Torso and head", /^(pelvis|spine\d|neck|head)$/, 50, UPRIGHT_TURNS],
  ["Left arm", /^left_(collar|shoulder|elbow|wrist)$/, 120, ARM_TURNS],
  ["Right arm", /^right_(collar|shoulder|elbow|wrist)$/, 120, ARM_TURNS],
  ["Left leg", /^left_(hip|knee|ankle|foot)$/, 110, LEG_TURNS],
  ["Right leg", /^right_(hip|knee|ankle|foot)$/, 110, LEG_TURNS],
  ["Face", /^(jaw|left_eye|right_eye)$/, 30, FACE_TURNS],
  ["Left hand", /^left_(index|middle|pinky|ring|thumb)\d$/, 90, FINGER_TURNS],
  ["Right hand", /^right_(index|middle|pinky|ring|thumb)\d$/, 90, FINGER_TURNS],
  ["Other", /./, 90, PLAIN_TURNS],
];
const PLAIN_SHAPES = new Map([["sex_male", "female to male"], ["age", "young to old"]]);
const SHAPE_REACH = 1.5;  // how far a shape slider goes from the person's own value

const element = (id) => document.getElementById(id);
const plainName = (name) => name.replace(/_/g, " ").replace(/(\D)(\d)$/, "$1 $2");
const plainShape = (name) => PLAIN_SHAPES.get(name) ?? plainName(name);
const plainExpression = (name) => name.replace(/_/g, " ").replace(/([a-z])([A-Z])/g, "$1 $2").toLowerCase();
const inDegrees = (value) => `${round(value)}°`;
const signed = (value) => `${value > 0 ? "+" : ""}${value.toFixed(1)}`.replace("-0.0", "0.0").replace("+0.0", "0.0");
const counted = (amount, thing) => `${amount.toLocaleString("en")} ${thing}${amount === 1 ? "" : "s"}`;

function makeControls(app) {
  const { scene } = app;
  element("facts").textContent = counted(scene.count - (scene.header.face?.hidden ?? 0), "Gaussian");

  for (const button of element("modes").children) button.onclick = () => app.setMode(button.dataset.mode);
  element("play").onclick = () => app.setPlaying(!app.playing);
  element("scrub").oninput = (event) => { app.setPlaying(false); app.setFrame(Number(event.target.value)); };
  element("speed").onchange = (event) => { app.speed = Number(event.target.value); };
  element("file").onchange = (event) => { openMotion(event.target.files[0]); event.target.value = ""; };
  element("ground").onchange = (event) => { app.look.ground = event.target.checked ? 1 : 0; app.invalidate(); };
  element("follow").onchange = (event) => { app.follow = event.target.checked; app.invalidate(); };
  element("frame-person").onclick = () => app.framePerson();
  element("show-help").onclick = () => element("help").showModal();
  element("reset-joints").onclick = () => resetJoints();
  element("reset-shape").onclick = () => resetShape();
  element("reset-face").onclick = () => resetFace();
  const showPanel = (open) => {
    document.body.classList.toggle("closed", !open);
    element("toggle-panel").setAttribute("aria-expanded", String(open));
    app.invalidate();
  };
  element("toggle-panel").onclick = () => showPanel(document.body.classList.contains("closed"));
  showPanel(innerWidth > PHONE);

  const swatches = BACKGROUNDS.map((color) => {
    const button = document.createElement("button");
    Object.assign(button, { title: color, onclick: () => setBackground(color) });
    button.setAttribute("aria-label", `background ${color}`);
    button.style.background = color;
    return button;
  });
  const anyColor = Object.assign(document.createElement("input"), { type: "color", title: "another colour" });
  anyColor.setAttribute("aria-label", "another background colour");
  anyColor.oninput = () => setBackground(anyColor.value);
  element("swatches").append(...swatches, anyColor);
  function setBackground(color) {
    app.look.transparent = color === "transparent";
    document.documentElement.classList.toggle("transparent", app.look.transparent);
    const opaque = app.look.transparent ? "#ffffff" : color;
    app.look.background = [1, 3, 5].map((i) => parseInt(opaque.slice(i, i + 2), 16) / 255);
    anyColor.value = opaque;
    swatches.forEach((s, i) => s.setAttribute("aria-pressed", String(BACKGROUNDS[i] === color)));
    document.documentElement.classList.toggle("dark", dot(app.look.background, [0.3, 0.59, 0.11]) < 0.45);
    document.body.style.background = color;
    app.invalidate();
  }
  setBackground(BACKGROUNDS[0]);

  // ---- sliders ----
  // Makes a row: what the slider does, the slider, and its value. label: a full description. home:
  // the value after a double click.
  const sliderRow = (caption, label, { low, high, value, home, step, shown }, onchange) => {
    const made = (tag, properties) => Object.assign(document.createElement(tag), properties);
    const input = made("input", { type: "range", min: low, max: high, step, value, title: label });
    const row = made("label", { className: "slider" }), output = made("output", {});
    const name = made("span", { textContent: caption });
    input.setAttribute("aria-label", label);
    const show = () => {
      output.textContent = shown(Number(input.value));
      input.setAttribute("aria-valuetext", output.textContent);
    };
    input.set = (to) => { input.value = to; show(); };
    input.oninput = () => { show(); onchange(Number(input.value)); };
    input.ondblclick = () => { input.set(home); onchange(home); };
    row.append(name, input, output);
    show();
    return row;
  };
  const taken = new Set(), marks = [];
  for (const [title, pattern, reach, turns] of GROUPS) {
    const members = scene.names.map((name, j) => [name, j]).filter(([name, j]) => pattern.test(name) && !taken.has(j));
    if (!members.length) continue;
    members.forEach(([, j]) => taken.add(j));
    const details = document.createElement("details"), summary = document.createElement("summary");
    summary.textContent = title;
    details.append(summary);
    marks.push([summary, members.map(([, j]) => j)]);
    details.addEventListener("toggle", () => {  // 165 sliders: made when they are first seen
      if (details.childElementCount > 1) return;
      for (const [name, j] of members) {
        const joint = Object.assign(document.createElement("div"), { className: "joint" });
        joint.append(Object.assign(document.createElement("b"), { textContent: plainName(name) }));
        const own = /thumb/.test(name) ? PLAIN_TURNS : turns;  // thumbs point along no axis
        own.forEach((does, axis) => {
          const letter = "xyz"[axis], label = `${plainName(name)}, about ${letter} (${does}), degrees`;
          const value = app.degrees[j][axis];
          const range = { low: -reach, high: reach, value, home: 0, step: 0.5, shown: inDegrees };
          joint.append(sliderRow(`${letter}: ${does}`, label, range, (v) => {
            app.degrees[j][axis] = v;
            jointsChanged();
          }));
        });
        details.append(joint);
      }
    });
    element("joints").append(details);
  }
  function jointsChanged() {
    for (const [summary, joints] of marks)
      summary.classList.toggle("changed", joints.some((j) => app.degrees[j].some((v) => v !== 0)));
    element("reset-joints").hidden = !app.degrees.some((d) => d.some((v) => v !== 0));
    app.invalidate();
  }
  function resetJoints() {
    app.degrees.forEach((d) => d.fill(0));
    for (const input of element("joints").querySelectorAll("input")) input.set(0);
    jointsChanged();
  }
  const { face, shape } = scene.header;
  if (face) {
    element("face-section").hidden = false;
    element("idle").onchange = (event) => app.idle.set(event.target.checked);
    element("idle").checked = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    app.idle.set(element("idle").checked);
    const taken = new Set();
    for (const [title, pattern] of REGIONS) {
      const members = face.names.map((name, e) => [name, e]).filter(([name, e]) => pattern.test(name) && !taken.has(e));
      if (!members.length) continue;
      const details = document.createElement("details"), summary = document.createElement("summary");
      summary.textContent = title;
      details.append(summary);
      details.dataset.members = members.map(([, e]) => e).join();
      for (const [name, e] of members) {
        taken.add(e);
        const range = { low: 0, high: 1, value: 0, home: 0, step: 0.01, shown: (v) => v.toFixed(2) };
        details.append(sliderRow(plainExpression(name), name, range, (v) => { app.expression[e] = v; faceChanged(); }));
      }
      element("face").append(details);
    }
  }
  function faceChanged() {
    for (const details of element("face").children)
      details.firstChild.classList.toggle("changed", details.dataset.members.split(",").some((e) => app.expression[e] !== 0));
    element("reset-face").hidden = !app.expression.some((v) => v !== 0);
    app.invalidate();
  }
  function resetFace() {
    app.expression.fill(0);
    for (const input of element("face").querySelectorAll("input")) input.set(0);
    faceChanged();
  }
  if (shape) {
    element("shape-section").hidden = false;
    shape.names.forEach((name, s) => {
      const home = shape.betas[s], low = home - SHAPE_REACH, high = home + SHAPE_REACH;
      const range = { low, high, value: home, home, step: 0.01, shown: signed };
      element("shape").append(sliderRow(plainShape(name), plainShape(name), range, (v) => {
        app.setShape(app.betas.map((b, i) => (i === s ? v : b)));
        element("reset-shape").hidden = false;
      }));
    });
  }
  function resetShape() {
    [...element("shape").querySelectorAll("input")].forEach((input, s) => input.set(shape.betas[s]));
    app.setShape([...shape.betas]);
    element("reset-shape").hidden = true;
  }

  // ---- files ----
  // Opens a motion. rate: frames per second that the user gave; null: those of the file. clip:
  // index of the motion in the file.
  async function openMotion(file, rate = null, clip = 0) {
    if (!file) return;
    element("ask-rate").hidden = true;
    try {
      const motion = await readMotionFile(file, scene, rate, clip);
      app.setMotion(motion, file.name);
      offerClips(file, motion.clips ?? [], clip);
      say(`${file.name}: ${counted(scene.motion.quats.length, "frame")}${motion.note ? `; ${motion.note}` : ""}`);
    } catch (error) {
      if (error.asksRate) askRate(file, error.message);
      else say(error.message, true);
    }
  }
  function offerClips(file, names, chosen) {
    const select = element("clip");
    select.replaceChildren(...names.map((name, i) => new Option(name, i, false, i === chosen)));
    select.onchange = () => openMotion(file, null, select.selectedIndex);
    element("clip-row").hidden = names.length < 2;
  }
  function askRate(file, question) {
    element("rate-question").textContent = question;
    element("ask-rate").hidden = false;
    element("ask-rate").onsubmit = (event) => {
      event.preventDefault();
      openMotion(file, element("rate-answer").valueAsNumber);
    };
    element("rate-answer").select();
  }
  element("leave-rate").onclick = () => { element("ask-rate").hidden = true; };
  element("fps").onchange = (event) => {
    if (scene.motion && event.target.checkValidity()) scene.motion.fps = event.target.valueAsNumber;
    app.invalidate();
  };
  let drags = 0;
  const dropping = (change) => { drags = Math.max(0, drags + change); document.body.classList.toggle("dropping", drags > 0); };
  addEventListener("dragenter", (event) => { event.preventDefault(); dropping(1); });
  addEventListener("dragleave", () => dropping(-1));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => { event.preventDefault(); dropping(-drags); openMotion(event.dataTransfer.files[0]); });

  // ---- keys ----
  addEventListener("keydown", (event) => {
    const { target, key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || element("help").open) return;
    const typing = target.matches?.("input:not([type=checkbox]), select"), arrow = key.startsWith("Arrow");
    if (typing && (arrow || target.type !== "range")) return;
    if (key === " " && target.matches?.("button, summary, label, input[type=checkbox]")) return;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (arrow && event.shiftKey) app.steer.turn(...steps[key].map((v) => -v * 20));
    else if (key === "ArrowLeft" || key === "ArrowRight") app.stepFrame(steps[key][0]);
    else if (key === "+" || key === "=") app.steer.zoom(0.9);
    else if (key === "-") app.steer.zoom(1 / 0.9);
    else {
      const act = new Map(Object.entries({
        " ": () => app.setPlaying(!app.playing), t: () => app.setMode("rest"), a: () => app.setMode("a"), m: () => app.setMode("motion"),
        f: () => app.framePerson(), r: () => { resetJoints(); if (face) resetFace(); if (shape) resetShape(); },
        g: () => element("ground").click(), p: () => element("toggle-panel").click(),
        h: () => { document.body.classList.toggle("hidden"); app.invalidate(); },
        b: () => { const at = BACKGROUNDS.indexOf(anyColor.value); setBackground(BACKGROUNDS[(at + 1) % BACKGROUNDS.length]); },
        "[": () => changeSpeed(-1), "]": () => changeSpeed(1), "?": () => element("show-help").click(),
      })).get(key.toLowerCase());
      if (!act) return;
      act();
    }
    event.preventDefault();
    app.invalidate();
  });
  function changeSpeed(by) {
    const select = element("speed");
    select.selectedIndex = Math.max(0, Math.min(select.options.length - 1, select.selectedIndex + by));
    select.onchange({ target: select });
  }

  function setFloor(shown) {
    element("ground").checked = shown;
    element("ground").onchange({ target: element("ground") });
  }

  return {
    setBackground, setFloor,
    // Shows the parts of the state that can change without a click.
    update() {
      const { motion } = scene, moving = app.mode === "motion" && motion;
      document.body.classList.toggle("still", !moving);
      document.body.classList.toggle("playing", Boolean(moving && app.playing));
      element("play").setAttribute("aria-label", app.playing ? "Pause" : "Play");
      for (const button of element("modes").children) {
        button.setAttribute("aria-checked", String(button.dataset.mode === app.mode));
        if (button.dataset.mode === "motion") button.disabled = !motion;
      }
      const about = motion && `${app.motionName}: ${counted(motion.quats.length, "frame")}`;
      element("motion-name").textContent = about || "no motion: drop a file";
      element("rate-row").hidden = !motion;
      if (motion && document.activeElement !== element("fps")) element("fps").value = round(motion.fps);
      if (!moving) return;
      const scrub = element("scrub"), last = motion.quats.length - 1;
      scrub.max = last;
      scrub.value = app.frame;
      const seconds = (frames) => (frames / motion.fps).toFixed(1);
      element("time").textContent = `${seconds(app.frame)} / ${seconds(last)} s`;
    },
    showRate(fps, active) {
      element("rate").textContent = fps ? `${Math.round(fps)} fps` : "";
      element("rate").style.opacity = active ? 1 : 0.5;
    },
  };
}

const round = (value) => String(Math.round(value * 100) / 100);

let messageTimer = 0;
function say(text, problem = false) {
  const box = element("message");
  box.textContent = text;
  box.className = problem ? "shown problem" : "shown";
  clearTimeout(messageTimer);
  messageTimer = setTimeout(() => { box.className = ""; }, problem ? 9000 : 3500);
}
