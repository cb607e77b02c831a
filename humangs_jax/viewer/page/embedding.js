// Options that an address can have, for pages that embed this one, such as
// ?autoplay&panel=0&background=transparent

const ON_OR_OFF = { pattern: /^[01]?$/, expected: "0 or 1" };
const OPTIONS = new Map(Object.entries({
  autoplay: ON_OR_OFF,
  panel: ON_OR_OFF,
  floor: ON_OR_OFF,
  background: { pattern: /^(transparent|#?[0-9a-f]{6})$/i, expected: "transparent, or six digits such as ffcc00" },
  pose: { pattern: /^[tam]$/i, expected: "t, a or m (T-pose, A-pose, motion)" },
  time: { pattern: /^\d+(\.\d*)?$/, expected: "seconds of the motion, such as 1.5" },
}));

// Returns { options, problems }: values by name, and lines about wrong values. Other names belong
// to other programs and are ignored.
function readOptions(search) {
  const options = new Map(), problems = [];
  for (const [name, value] of new URLSearchParams(search)) {
    const known = OPTIONS.get(name);
    if (!known) continue;
    if (known.pattern.test(value)) options.set(name, value.toLowerCase());
    else problems.push(`${name}=${value}: expected ${known.expected}`);
  }
  return { options, problems };
}

function applyOptions(app, controls, search) {
  const { options, problems } = readOptions(search), { motion } = app.scene;
  const off = (name) => options.get(name) === "0";
  const background = options.get("background");
  if (background === "transparent") controls.setBackground(background);
  else if (background) controls.setBackground(`#${background.replace("#", "")}`);
  if (options.has("floor")) controls.setFloor(!off("floor"));
  else if (background === "transparent") controls.setFloor(false);
  if (off("panel")) document.body.classList.add("hidden");
  if (options.has("time") && motion) app.setFrame(Number(options.get("time")) * motion.fps);
  if (options.has("pose")) app.setMode(options.get("pose").replace("t", "rest").replace("m", "motion"));
  if (off("autoplay")) app.setPlaying(false);
  if (problems.length) say(problems.join("; "), true);
}
