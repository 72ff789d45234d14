// The page's state in the fragment of its address. Every value in an address is checked.

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const short = (x) => String(Number(x.toPrecision(7)));

const LIMITS = { ev: [-16, 16], gamma: [0.5, 6], white: [-2, 8] };  // stops, exponent, stops

function linkOf(state) {
  const out = new URLSearchParams();
  for (const name of Object.keys(LIMITS)) out.set(name, short(state.look[name]));
  out.set("curve", state.look.curve);
  out.set("show", state.show);
  if (state.look.balance.some((b) => b)) out.set("wb", state.look.balance.map(short).join(","));
  if (state.look.camera >= 0) out.set("camera", state.look.camera);
  if (state.show === "split") out.set("line", short(state.look.split));
  if (state.at !== null) out.set("at", state.at);
  else {
    const { R, c, lens } = state.camera;
    out.set("c", c.map(short).join(","));
    out.set("q", quaternion(R).map(short).join(","));
    out.set("lens", ["width", "height", "fx", "fy", "cx", "cy"].map((k) => short(lens[k])).join(","));
  }
  return "#" + out.toString().replaceAll("%2C", ",");
}

function numbers(text, count) {
  if (!text) return null;
  const values = text.split(",").map(Number);
  return values.length === count && values.every(Number.isFinite) ? values : null;
}

// Apply the valid values of a fragment; other values do not change.
function followLink(hash, state, scene, curves) {
  const given = new URLSearchParams(hash.slice(1));
  for (const [name, [low, high]] of Object.entries(LIMITS)) {
    const value = numbers(given.get(name), 1);
    if (value) state.look[name] = clamp(value[0], low, high);
  }
  if (curves.includes(given.get("curve"))) state.look.curve = given.get("curve");
  if (SHOWS.includes(given.get("show"))) state.show = given.get("show");
  const balance = numbers(given.get("wb"), 3);
  if (balance) state.look.balance = balance.map((b) => clamp(b, -3, 3));
  const row = numbers(given.get("camera"), 1);
  if (row && scene.tone.cameras[row[0]] !== undefined) state.look.camera = row[0];
  const line = numbers(given.get("line"), 1);
  if (line) state.look.split = clamp(line[0], 0, 1);
  const at = numbers(given.get("at"), 1);
  if (at && scene.views[at[0]]) {
    state.at = at[0];
    state.camera = cameraOf(scene.views[at[0]]);
    return;
  }
  const [c, q, lens] = [numbers(given.get("c"), 3), numbers(given.get("q"), 4), numbers(given.get("lens"), 6)];
  if (!c || !q || !lens || Math.hypot(...q) < 0.1 || lens.slice(0, 4).some((v) => !(v > 0))) return;
  const [width, height, fx, fy, cx, cy] = lens, n = Math.hypot(...q);
  state.at = null;
  state.camera = { R: rotation(q.map((v) => v / n)), c, lens: { width, height, fx, fy, cx, cy } };
}
