// Everything people click, drag or press. `app` (main.js) holds the state; controls change it and say so.

const BACKGROUNDS = ["#f6f5f2", "#ffffff", "#c9d3dc", "#4c5158", "#15171a"];
const GROUPS = [
  ["Torso and head", /^(pelvis|spine\d|neck|head)$/, 50],
  ["Left arm", /^left_(collar|shoulder|elbow|wrist)$/, 120],
  ["Right arm", /^right_(collar|shoulder|elbow|wrist)$/, 120],
  ["Left leg", /^left_(hip|knee|ankle|foot)$/, 110],
  ["Right leg", /^right_(hip|knee|ankle|foot)$/, 110],
  ["Face", /^(jaw|left_eye|right_eye)$/, 30],
  ["Left hand", /^left_(index|middle|pinky|ring|thumb)\d$/, 90],
  ["Right hand", /^right_(index|middle|pinky|ring|thumb)\d$/, 90],
  ["Other", /./, 90],
];
const SHAPE_REACH = 1.5;  // how far a shape slider goes from the person's own value

const element = (id) => document.getElementById(id);
const plainName = (name) => name.replace(/_/g, " ").replace(/(\D)(\d)$/, "$1 $2");

function makeControls(app) {
  const { scene } = app;
  element("facts").textContent = `${scene.count.toLocaleString("en")} Gaussians`;

  for (const button of element("modes").children) button.onclick = () => app.setMode(button.dataset.mode);
  element("play").onclick = () => app.setPlaying(!app.playing);
  element("scrub").oninput = (event) => { app.setPlaying(false); app.setFrame(Number(event.target.value)); };
  element("speed").onchange = (event) => { app.speed = Number(event.target.value); };
  element("file").onchange = (event) => { openMotion(event.target.files[0]); event.target.value = ""; };
  element("ground").onchange = (event) => { app.look.ground = event.target.checked ? 1 : 0; app.invalidate(); };
  element("follow").onchange = (event) => { app.follow = event.target.checked; app.invalidate(); };
  element("frame-person").onclick = () => app.framePerson();
  element("save-image").onclick = () => app.saveImage();
  element("reset-joints").onclick = () => resetJoints();
  element("reset-shape").onclick = () => resetShape();
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
    app.look.background = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16) / 255);
    anyColor.value = color;
    swatches.forEach((s, i) => s.setAttribute("aria-pressed", String(BACKGROUNDS[i] === color)));
    document.documentElement.classList.toggle("dark", dot(app.look.background, [0.3, 0.59, 0.11]) < 0.45);
    document.body.style.background = color;
    app.invalidate();
  }
  setBackground(BACKGROUNDS[0]);

  // ---- sliders ----
  const slider = (label, low, high, value, step, oninput) => {
    const input = Object.assign(document.createElement("input"), { type: "range", min: low, max: high, step, value, title: label });
    input.setAttribute("aria-label", label);
    const home = value;
    input.oninput = () => oninput(Number(input.value));
    input.ondblclick = () => { input.value = home; oninput(home); };
    return input;
  };
  const taken = new Set(), marks = [];
  for (const [title, pattern, reach] of GROUPS) {
    const members = scene.names.map((name, j) => [name, j]).filter(([name, j]) => pattern.test(name) && !taken.has(j));
    if (!members.length) continue;
    members.forEach(([, j]) => taken.add(j));
    const details = document.createElement("details"), summary = document.createElement("summary");
    summary.textContent = title;
    details.append(summary);
    marks.push([summary, members.map(([, j]) => j)]);
    details.addEventListener("toggle", () => {  // 165 sliders: made when they are first seen
      if (details.childElementCount > 1) return;
      const heads = Object.assign(document.createElement("div"), { className: "joint heads", innerHTML: "<div><b>x</b><b>y</b><b>z</b></div>" });
      details.append(heads);
      for (const [name, j] of members) {
        const row = document.createElement("div"), caption = document.createElement("span"), axes = document.createElement("div");
        row.className = "joint";
        caption.textContent = plainName(name);
        for (let axis = 0; axis < 3; axis++)
          axes.append(slider(`${plainName(name)}, about ${"xyz"[axis]}, degrees`, -reach, reach, app.degrees[j][axis], 0.5, (v) => {
            app.degrees[j][axis] = v;
            jointsChanged();
          }));
        row.append(caption, axes);
        details.append(row);
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
    for (const input of element("joints").querySelectorAll("input")) input.value = 0;
    jointsChanged();
  }
  const { shape } = scene.header;
  if (shape) {
    element("shape-section").hidden = false;
    shape.names.forEach((name, s) => {
      const row = document.createElement("label"), caption = document.createElement("span"), own = shape.betas[s];
      row.className = "row";
      caption.textContent = plainName(name);
      row.append(caption, slider(plainName(name), own - SHAPE_REACH, own + SHAPE_REACH, own, 0.01, (v) => {
        app.setShape(app.betas.map((b, i) => (i === s ? v : b)));
        element("reset-shape").hidden = false;
      }));
      element("shape").append(row);
    });
  }
  function resetShape() {
    [...element("shape").querySelectorAll("input")].forEach((input, s) => { input.value = shape.betas[s]; });
    app.setShape([...shape.betas]);
    element("reset-shape").hidden = true;
  }

  // ---- files ----
  async function openMotion(file) {
    if (!file) return;
    try {
      const motion = await readMotionFile(file, scene);
      app.setMotion(motion, file.name);
      say(`${file.name}: ${scene.motion.quats.length} frames${motion.said ? `; ${motion.said}` : ""}`);
    } catch (error) {
      say(error.message, true);
    }
  }
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
        f: () => app.framePerson(), r: () => { resetJoints(); if (shape) resetShape(); },
        g: () => element("ground").click(), p: () => element("toggle-panel").click(),
        h: () => { document.body.classList.toggle("hidden"); app.invalidate(); },
        b: () => { const at = BACKGROUNDS.indexOf(anyColor.value); setBackground(BACKGROUNDS[(at + 1) % BACKGROUNDS.length]); },
        "[": () => changeSpeed(-1), "]": () => changeSpeed(1), "?": () => element("help").showModal(),
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

  return {
    // Shows the state that changes without a click.
    update() {
      const { motion } = scene, moving = app.mode === "motion" && motion;
      document.body.classList.toggle("still", !moving);
      document.body.classList.toggle("playing", Boolean(moving && app.playing));
      element("play").setAttribute("aria-label", app.playing ? "Pause" : "Play");
      for (const button of element("modes").children) {
        button.setAttribute("aria-checked", String(button.dataset.mode === app.mode));
        if (button.dataset.mode === "motion") button.disabled = !motion;
      }
      element("motion-name").textContent = motion ? `${app.motionName}: ${motion.quats.length} frames, ${round(motion.fps)} fps` : "no motion: drop a file";
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
