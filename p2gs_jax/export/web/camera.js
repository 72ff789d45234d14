// Cameras have the run's axes (x right, y down, z forward), a rotation R from world to camera
// (row-major) and a centre c in the world.
// A view's lens is {width, height, fx, fy, cx, cy}, pixels; in a window it is [fx, fy, cx, cy].

const row = (m, i) => [m[3 * i], m[3 * i + 1], m[3 * i + 2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => plus([0, 0, 0], a, 1 / (length(a) || 1));
const times = (m, v) => [dot(row(m, 0), v), dot(row(m, 1), v), dot(row(m, 2), v)];

function cameraOf(view) {
  const m = view.viewmat, R = [...m.slice(0, 3), ...m.slice(4, 7), ...m.slice(8, 11)];
  const t = [m[3], m[7], m[11]];
  const c = [0, 1, 2].map((k) => -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2]));
  const [fx, fy, cx, cy] = view.K;
  return { R, c, lens: { width: view.width, height: view.height, fx, fy, cx, cy } };
}

// Return the window pixels per pixel of a lens's picture that is shown completely.
const fit = (lens, width, height) => Math.min(width / lens.width, height / lens.height);

function intoWindow({ R, c, lens }, width, height) {
  const s = fit(lens, width, height);
  const middle = [width / 2 + s * (lens.cx - lens.width / 2),
    height / 2 + s * (lens.cy - lens.height / 2)];
  return { R, c, lens: [s * lens.fx, s * lens.fy, ...middle] };
}

function projectPoint(camera, p) {
  const [x, y, z] = times(camera.R, plus(p, camera.c, -1)), [fx, fy, cx, cy] = camera.lens;
  return [(fx * x) / z + cx, (fy * y) / z + cy, z];
}

function turn(axis, angle) {
  const [x, y, z] = unit(axis), c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [x * x * k + c, x * y * k - z * s, x * z * k + y * s, x * y * k + z * s, y * y * k + c,
    y * z * k - x * s, x * z * k - y * s, y * z * k + x * s, z * z * k + c];
}

// Return the point at a depth on the ray of a pixel.
function pointAt({ R, c, lens: [fx, fy, cx, cy] }, x, y, depth) {
  const ray = [((x - cx) / fx) * depth, ((y - cy) / fy) * depth, depth];
  return plus(c, [0, 1, 2].map((k) => R[k] * ray[0] + R[3 + k] * ray[1] + R[6 + k] * ray[2]));
}

// Return a camera turned about a point, by a rotation of the world.
function turned(camera, M, about) {
  const R = [0, 1, 2].flatMap((i) => times(M, row(camera.R, i)));
  return { ...camera, R, c: plus(about, times(M, plus(camera.c, about, -1))) };
}

// Return a camera after a yaw about `up` and a pitch about its x axis. A pitch counts if it ends
// before the vertical or leads away from it.
function lookAround(camera, yaw, pitch, about, up) {
  const out = turned(camera, turn(up, yaw), about);
  const tilted = turned(out, turn(row(out.R, 0), pitch), about);
  const steep = (view) => Math.abs(dot(row(view.R, 2), up));
  return steep(tilted) < Math.max(0.99, steep(out)) ? tilted : out;
}

function quaternion(R) {
  const [a, b, c, d, e, f, g, h, i] = R;
  const four = [[1 + a + e + i, h - f, c - g, d - b], [h - f, 1 + a - e - i, b + d, c + g],
    [c - g, b + d, 1 - a + e - i, f + h], [d - b, c + g, f + h, 1 - a - e + i]];
  const best = four.reduce((x, y, k) => (y[k] > x.most ? { most: y[k], q: y } : x), { most: 0 }).q;
  const n = Math.hypot(...best);
  return best.map((v) => v / n);
}

function rotation([w, x, y, z]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

// Return a camera between two others: it is on the line between their centres, its rotation is on
// the arc between their rotations, and it has the lens of the nearer camera.
function between(a, b, share) {
  const p = quaternion(a.R), q = quaternion(b.R);
  let cos = p.reduce((s, v, k) => s + v * q[k], 0);
  const sign = cos < 0 ? -1 : 1;
  cos = Math.min(1, sign * cos);
  const angle = Math.acos(cos), small = angle < 1e-4;
  const [u, v] = small ? [1 - share, share]
    : [Math.sin((1 - share) * angle) / Math.sin(angle), Math.sin(share * angle) / Math.sin(angle)];
  const mixed = p.map((value, k) => u * value + v * sign * q[k]), n = Math.hypot(...mixed);
  return { R: rotation(mixed.map((value) => value / n)), c: plus(a.c, plus(b.c, a.c, -1), share),
    lens: share < 0.5 ? a.lens : b.lens };
}

// Return the first quartile of depths of Gaussians more opaque than 0.5 near a pixel, or null.
function depthAt(splats, camera, x, y) {
  const found = [], opacities = splats.triples[3], reach = 24;
  const { means } = splats, { R, c } = camera, [fx, fy, cx, cy] = camera.lens;
  for (let i = 0; i < splats.count; i++) {
    if (opacities[3 * i] < 0) continue;
    const dx = means[3 * i] - c[0], dy = means[3 * i + 1] - c[1], dz = means[3 * i + 2] - c[2];
    const z = R[6] * dx + R[7] * dy + R[8] * dz;
    if (!(z > 0.05)) continue;
    const px = (fx * (R[0] * dx + R[1] * dy + R[2] * dz)) / z + cx;
    const py = (fy * (R[3] * dx + R[4] * dy + R[5] * dz)) / z + cy;
    if (Math.abs(px - x) < reach && Math.abs(py - y) < reach) found.push(z);
  }
  return found.length ? found.sort((a, b) => a - b)[Math.floor(found.length / 4)] : null;
}
