// Mouse, touch and keys that move the camera.

// Speeds in radians per pixel, radians per second, and scene depths per second; factor of Shift.
const TURN = 0.005, KEYS_TURN = 0.9, KEYS_STEP = 0.5, FAST = 4;
const MOVES = ["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE", "ShiftLeft", "ShiftRight",
  "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"];

const typing = (e) => e.ctrlKey || e.metaKey || e.altKey || e.target.matches("select, [type=number]") ||
  (e.target.matches("[type=range]") && e.code.startsWith("Arrow"));

class Hands {
  // `page` is the Page of main.js; its moved(), clicked() and grabbed() are called.
  constructor(element, page) {
    Object.assign(this, { element, page, fingers: new Map(), held: new Set(), travelled: 0 });
    element.addEventListener("pointerdown", (e) => this.down(e));
    element.addEventListener("pointermove", (e) => this.move(e));
    for (const name of ["pointerup", "pointercancel"])
      element.addEventListener(name, (e) => this.up(e));
    element.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.approach(Math.exp(-0.0015 * clamp(e.deltaY, -300, 300)));
    }, { passive: false });
    element.addEventListener("contextmenu", (e) => e.preventDefault());
    addEventListener("keydown", (e) => {
      if (!typing(e) && MOVES.includes(e.code)) {
        this.held.add(e.code);
        e.preventDefault();
        page.wake();
      }
    });
    addEventListener("keyup", (e) => this.held.delete(e.code));
    addEventListener("blur", () => this.held.clear());
  }

  down(e) {
    this.element.setPointerCapture(e.pointerId);
    this.fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    this.travelled = this.fingers.size > 1 ? Infinity : 0;
    this.pans = e.button === 2 || e.button === 1 || e.shiftKey;
    if (this.fingers.size === 1) this.page.grabbed(e.clientX, e.clientY);
  }

  move(e) {
    const finger = this.fingers.get(e.pointerId);
    if (!finger) return;
    const before = this.middle(), apart = this.apart();
    const dx = e.clientX - finger.x, dy = e.clientY - finger.y;
    Object.assign(finger, { x: e.clientX, y: e.clientY });
    this.travelled += Math.hypot(dx, dy);
    if (this.travelled < 4) return;  // pixels; so far this may be a click
    if (this.fingers.size === 1 && !this.pans) return this.turn(dx, dy);
    const after = this.middle();
    this.pan(after.x - before.x, after.y - before.y);
    if (apart && this.apart()) this.approach(this.apart() / apart);
  }

  up(e) {
    if (this.fingers.delete(e.pointerId) && this.travelled < 4 && e.type === "pointerup")
      this.page.clicked(e.clientX, e.clientY);
  }

  middle() {
    const all = [...this.fingers.values()];
    return { x: all.reduce((s, f) => s + f.x, 0) / all.length,
      y: all.reduce((s, f) => s + f.y, 0) / all.length };
  }

  apart() {
    const [a, b] = [...this.fingers.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }

  // The picture follows the pointer, whether the camera turns or orbits.
  turn(dx, dy) {
    const { page } = this, by = page.fly ? TURN : -TURN;
    page.moved(lookAround(page.camera, by * dx, by * dy, page.fly ? page.camera.c : page.pivot, page.up));
  }

  pan(dx, dy) {
    const { page } = this, { R, c } = page.camera;
    const step = page.depthOfPivot() / page.focal();
    const by = plus(plus([0, 0, 0], row(R, 0), -dx * step), row(R, 1), -dy * step);
    page.pivot = plus(page.pivot, by);
    page.moved({ ...page.camera, c: plus(c, by) });
  }

  approach(factor) {
    const { page } = this, depth = page.depthOfPivot();
    const step = Math.max(depth * (1 - 1 / factor), depth - 50 * page.depth);
    page.moved({ ...page.camera, c: plus(page.camera.c, row(page.camera.R, 2), step) });
    if (page.depthOfPivot() < 0.02 * page.depth)
      page.pivot = plus(page.camera.c, row(page.camera.R, 2), 0.02 * page.depth);
  }

  // Move while keys are pressed; return whether a key is pressed.
  steer(seconds) {
    const { page, held } = this, on = (...codes) => (codes.some((c) => held.has(c)) ? 1 : 0);
    if (![...held].some((code) => !code.startsWith("Shift"))) return false;
    const fast = on("ShiftLeft", "ShiftRight") ? FAST : 1;
    const step = KEYS_STEP * page.depth * seconds * fast, { R } = page.camera;
    const by = [on("KeyD") - on("KeyA"), on("KeyE") - on("KeyQ"), on("KeyW") - on("KeyS")];
    let shift = plus(plus([0, 0, 0], row(R, 0), by[0] * step), row(R, 2), by[2] * step);
    shift = plus(shift, page.up, by[1] * step);
    page.pivot = plus(page.pivot, shift);
    const angle = KEYS_TURN * seconds;
    const yaw = on("ArrowLeft") - on("ArrowRight"), pitch = on("ArrowUp") - on("ArrowDown");
    const camera = { ...page.camera, c: plus(page.camera.c, shift) };
    page.moved(lookAround(camera, yaw * angle, pitch * angle, camera.c, page.up));
    return true;
  }
}
