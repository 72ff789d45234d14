// The page: its state, the effects of its controls, and when it draws.

const SHOWS = ["picture", "stops", "clipping", "split"];
const SHOW_NAMES = { picture: "picture", stops: "stops", clipping: "clipping", split: "photo | render" };
const CURVE_NAMES = { spline: "fitted", srgb: "sRGB", power: "power 2.2", linear: "none" };
// While the camera moves, frames that take more than SLOW seconds become smaller, down to the scale
// SMALLEST, and those below QUICK larger. REST seconds after a move they have the full size.
const SLOW = 0.06, QUICK = 0.03, SMALLEST = 0.2, REST = 0.25;

const $ = (id) => document.getElementById(id);
// Return the picture's pixels per CSS pixel; more than two are not visible.
const density = () => Math.min(devicePixelRatio, 2);

class Page {
  constructor(scene, splats) {
    this.scene = scene;
    this.splats = splats;
    this.up = scene.up;
    this.depth = scene.depth = 1;
    this.fly = false;
    this.marksShown = false;
    this.curves = ["spline", "srgb", "power", "linear"].filter((c) => c !== "spline" || scene.tone.tables);
    this.exported = { ...scene.look, white: 0, camera: -1, mode: 0, split: 0, vignetting: true, hdr: true };
    this.state = { look: { ...this.exported, split: 0.5 }, show: "picture", at: scene.start,
      camera: cameraOf(scene.views[scene.start]) };
    this.scale = 1;
    this.lastMoved = -1;
    this.frames = [];
    this.sortedFor = null;
    this.playing = false;
    this.renderer = new Renderer($("picture"), scene, splats, location.search === "?half" ? 16 : 32);
    this.measureDepth();
    this.marks = new Marks($("marks"), scene);
    this.hands = new Hands($("hands"), this);
    this.controls();
    followLink(location.hash, this.state, scene, this.curves);
    this.choosePhotograph();
    this.show();
    addEventListener("resize", () => this.wake());
    this.awaitLoss($("picture"));
    addEventListener("hashchange", () => {
      if (location.hash === this.written) return;
      followLink(location.hash, this.state, scene, this.curves);
      this.choosePhotograph();
      this.show();
    });
    // The first picture waits until its Gaussians are sorted.
    this.ready = this.renderer.sort(this.windowCamera()).then((row) => {
      this.sortedFor = row;
      this.newOrder = true;
      this.wake();
      return new Promise(requestAnimationFrame);
    });
  }

  // The device may be lost and return, for example while a phone has the page in the background.
  awaitLoss(canvas) {
    canvas.addEventListener("webglcontextlost", (e) => {
      e.preventDefault();
      this.lost = true;
      $("status").textContent = "The graphics device was lost; the picture returns with it.";
    });
    canvas.addEventListener("webglcontextrestored", () => {
      try { this.renderer.build(this.splats); } catch (error) { complain(error); }
      this.lost = false;
      this.pose = this.photographOf = null;
      this.choosePhotograph();
      this.wake();
    });
  }

  measureDepth() {  // at the middle of a window of 800 x 600 pixels
    const camera = intoWindow(this.state.camera, 800, 600);
    this.depth = this.scene.depth = depthAt(this.splats, camera, 400, 300) || 10;
    this.pivot = plus(this.state.camera.c, row(this.state.camera.R, 2), this.depth);
  }

  get camera() { return this.state.camera; }

  windowCamera(share = 1) {
    const { clientWidth, clientHeight } = $("picture"), pixels = density() * share;
    const size = [clientWidth, clientHeight].map((v) => Math.max(1, Math.round(v * pixels)));
    return { ...intoWindow(this.state.camera, ...size), size };
  }

  focal() { return this.windowCamera(1 / density()).lens[0]; }

  depthOfPivot() {
    const { R, c } = this.state.camera;
    return Math.max(dot(row(R, 2), plus(this.pivot, c, -1)), 0.01 * this.depth);
  }

  // hands.js calls the next three methods.
  grabbed(x, y) {
    $("hands").focus({ preventScroll: true });
    const camera = this.windowCamera(1 / density());
    const depth = depthAt(this.splats, camera, x, y);
    if (depth) this.pivot = pointAt(camera, x, y, depth);
  }

  clicked(x, y) {
    const index = this.marks.find(x * density(), y * density(), 16 * density());
    if (index !== null) this.go(index);
  }

  moved(camera) {
    this.state.camera = camera;
    this.state.at = null;
    this.stop();
    this.show();
  }

  // Go to a photograph's pose, and use its exposure unless the control says not to.
  go(index) {
    this.stop();
    this.state.at = index;
    this.state.camera = cameraOf(this.scene.views[index]);
    if (!$("keep").checked) this.match(this.scene.views[index]);
    const depth = depthAt(this.splats, intoWindow(this.camera, 800, 600), 400, 300);
    this.pivot = plus(this.camera.c, row(this.camera.R, 2), depth || this.depth);
    this.choosePhotograph();
    this.show();
  }

  match(view) {
    const { ev, gamma, balance, row: camera } = view;
    Object.assign(this.state.look, { ev, gamma, balance, camera, curve: this.scene.look.curve });
  }

  // Give the photograph to the renderer if the page has it.
  async choosePhotograph() {
    const data = this.scene.photographs[this.state.at];
    if (!data || this.photographOf === this.state.at) return;
    const image = new Image(), index = this.state.at;
    image.src = data;
    await image.decode();
    if (this.state.at !== index) return;  // another view was chosen meanwhile
    this.renderer.setPhotograph(image);
    this.photographOf = index;
    this.wake();
  }

  step(by) {
    const count = this.scene.views.length;
    const here = this.state.at === null ? this.nearest() : this.state.at + by;
    this.go((here + count) % count);
  }

  nearest() {
    const far = this.marks.cameras.map((view) => length(plus(view.c, this.camera.c, -1)));
    return far.indexOf(Math.min(...far));
  }

  controls() {
    const { look } = this.state, wake = () => this.show();
    const change = (id, event, act) => $(id).addEventListener(event, () => { act($(id)); wake(); });
    for (const id of ["ev", "white", "gamma"]) {
      change(id, "input", (e) => { look[id] = Number(e.value); });
      $(id).addEventListener("dblclick", () => { look[id] = this.exported[id]; wake(); });
    }
    fill($("curve"), this.curves.map((c) => [c, CURVE_NAMES[c]]));
    change("curve", "change", (e) => { look.curve = e.value; });
    change("vignetting", "change", (e) => { look.vignetting = e.checked; });
    change("hdr", "change", (e) => { look.hdr = e.checked; });
    change("reset", "click", () => this.reset());
    change("line", "input", (e) => { look.split = Number(e.value); });
    for (const show of SHOWS) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: SHOW_NAMES[show], id: `show-${show}` });
      button.addEventListener("click", () => this.choose(show));
      $("shows").append(button);
    }
    const none = !Object.keys(this.scene.photographs).length;
    $("show-split").disabled = none;
    if (none) $("show-split").title = "The page contains no photographs (--photographs)";
    fill($("at"), [["", "—"], ...this.scene.views.map((v, i) => [i, v.name])]);
    change("at", "change", (e) => e.value !== "" && this.go(Number(e.value)));
    change("previous", "click", () => this.step(-1));
    change("next", "click", () => this.step(1));
    change("cameras", "change", (e) => { this.marksShown = e.checked; });
    change("fly", "change", (e) => { this.fly = e.checked; });
    this.driveControls(change);
    $("vignetting-line").hidden = !this.scene.tone.cameras.some((rows) => rows.length);
    $("hdr-line").hidden = !this.renderer.extended;
    this.scene.stopColors.forEach((rgb, k) => {
      const step = document.createElement("span");
      step.style.background = `rgb(${rgb.map((v) => Math.round(255 * v)).join(" ")})`;
      step.textContent = k % 2 ? "" : k - 6;
      $("legend").append(step);
    });
    for (const sentence of this.scene.about) {
      const p = document.createElement("p");
      p.textContent = sentence;
      $("about").append(p);
    }
    $("panel").addEventListener("submit", (e) => e.preventDefault());
    $("fold").addEventListener("click", () => this.fold());
    if (innerWidth <= 640) this.fold();
    addEventListener("keydown", (e) => this.key(e));
  }

  driveControls(change) {
    const names = [...new Set(this.scene.views.map((v) => v.camera))];
    this.drives = names
      .map((name) => this.scene.views.flatMap((v, i) => (v.camera === name ? [i] : [])))
      .filter((rows) => rows.length > 1);
    fill($("along"), this.drives.map((rows, k) => [k, this.scene.views[rows[0]].camera]));
    $("along-line").hidden = this.drives.length < 2;
    $("drive").hidden = !this.drives.length;
    if (!this.drives.length) return;
    const along = () => {
      $("place").max = this.drives[$("along").value].length - 1;
      $("place").value = 0;
    };
    along();
    change("along", "change", () => { along(); this.drive(0); });
    change("place", "input", (e) => { this.stop(); this.drive(Number(e.value)); });
    change("play", "click", () => (this.playing ? this.stop() : this.play()));
  }

  play() {
    if ($("drive").hidden) return;
    this.playing = true;
    $("play").textContent = "❚❚ pause";
    this.wake();
  }

  stop() {
    this.playing = false;
    $("play").textContent = "▶ play";
  }

  // Go to a position along the drive, counted in photographs.
  drive(place) {
    const views = this.drives[$("along").value].map((i) => this.scene.views[i]);
    const first = Math.min(Math.floor(place), views.length - 2), share = place - first;
    const [a, b] = [views[first], views[first + 1]];
    this.state.at = null;
    this.state.camera = between(cameraOf(a), cameraOf(b), share);
    this.pivot = plus(this.camera.c, row(this.camera.R, 2), this.depth);
    if ($("matched").checked) {
      const mix = (x, y) => (1 - share) * x + share * y;
      const balance = a.balance.map((v, k) => mix(v, b.balance[k]));
      this.match({ ev: mix(a.ev, b.ev), gamma: mix(a.gamma, b.gamma), balance, row: a.row });
    }
    $("place").value = place;
    this.show();
  }

  choose(show) {
    this.state.show = show;
    if (show === "split" && !this.scene.photographs[this.state.at]) {
      const here = this.nearest();
      const ones = Object.keys(this.scene.photographs).map(Number);
      if (ones.length) this.go(ones.reduce((a, b) => (Math.abs(b - here) < Math.abs(a - here) ? b : a)));
    }
    this.show();
  }

  reset() {
    Object.assign(this.state.look, this.exported, { split: 0.5 });
  }

  fold() {
    const hidden = ($("panel").hidden = !$("panel").hidden);
    $("fold").setAttribute("aria-expanded", String(!hidden));
  }

  key(e) {
    if (typing(e)) return;
    const { look } = this.state;
    const acts = {
      "[": () => { look.ev -= 1 / 3; }, "]": () => { look.ev += 1 / 3; },
      n: () => this.step(1), p: () => this.step(-1),
      c: () => { this.marksShown = !this.marksShown; }, f: () => { this.fly = !this.fly; },
      r: () => this.reset(), h: () => this.fold(),
      " ": () => (this.playing ? this.stop() : this.play()),
    };
    SHOWS.forEach((show, k) => { acts[k + 1] = () => $(`show-${show}`).disabled || this.choose(show); });
    const act = acts[e.key.toLowerCase()];
    if (!act || (e.key === " " && e.target.matches("button, summary, [type=checkbox]"))) return;
    e.preventDefault();
    act();
    look.ev = clamp(look.ev, ...LIMITS.ev);
    this.show();
  }

  // Show the state in the controls, and draw.
  show() {
    const { look, show, at } = this.state;
    const sign = (v) => (v > 0 ? "+" : v < 0 ? "−" : "") + Math.abs(v).toFixed(2);
    for (const id of ["ev", "white", "gamma"]) $(id).value = look[id];
    $("ev-value").textContent = `${sign(look.ev)} EV`;
    $("white-value").textContent = `${sign(look.white)} EV`;
    $("gamma-value").textContent = look.gamma.toFixed(2);
    $("curve").value = look.curve;
    $("vignetting").checked = look.vignetting;
    $("hdr").checked = look.hdr;
    $("line").value = look.split;
    $("line-line").hidden = show !== "split";
    $("legend").hidden = show !== "stops";
    for (const name of SHOWS) $(`show-${name}`).setAttribute("aria-pressed", String(name === show));
    $("at").value = at === null ? "" : at;
    $("cameras").checked = this.marksShown;
    $("fly").checked = this.fly;
    this.wake();
  }

  wake() {
    if (this.asleep === false) return;
    this.asleep = false;
    requestAnimationFrame((now) => {
      try { this.frame(now / 1000); } catch (error) { complain(error); }
    });
  }

  frame(now) {
    this.asleep = true;
    if (this.lost) return;
    // After a rest the speed is unknown.
    const passed = this.lastFrame ? Math.min(now - this.lastFrame, 0.5) : 0;
    const steered = this.hands.steer(passed || 0.016);
    if (this.playing) {
      const last = this.drives[$("along").value].length - 1;
      const pace = clamp(Number($("pace").value) || 1, 0.1, 30);
      this.drive((Number($("place").value) + passed * pace) % last);
    }
    const pose = JSON.stringify([this.state.camera, innerWidth, innerHeight, density()]);
    const moved = pose !== this.pose;
    this.pose = pose;
    if (moved) {
      this.adapt(passed);
      this.lastMoved = now;
    }
    const resting = now - this.lastMoved > REST;
    const share = resting ? 1 : this.scale;
    if (moved || this.newOrder || share !== this.drawn) this.render(share);
    this.draw();
    this.say(now, moved || this.newOrder);
    this.newOrder = false;
    const goesOn = steered || this.playing || !resting;
    this.lastFrame = goesOn ? now : null;
    if (goesOn) this.wake();
    else {
      this.frames = [];
      clearTimeout(this.linking);
      this.linking = setTimeout(() => this.writeLink(), 250);
    }
  }

  // Draw smaller pictures if the device is too slow, and larger ones if it is fast.
  adapt(passed) {
    if (passed > SLOW) this.scale = Math.max(SMALLEST, this.scale * 0.8);
    else if (passed > 0 && passed < QUICK) this.scale = Math.min(1, this.scale * 1.1);
  }

  render(share) {
    const camera = this.windowCamera(share);
    this.renderer.render(camera, ...camera.size);
    this.drawn = share;
    const sorting = this.renderer.sort(camera), sortedPose = this.pose;
    if (sorting)
      sorting.then((row) => {
        const same = this.sortedFor && row.every((v, k) => v === this.sortedFor[k]);
        this.sortedFor = row;
        // The camera may have moved while the worker was busy.
        if (same && sortedPose === this.pose) return;
        this.newOrder = true;
        this.wake();
      });
  }

  draw() {
    const { renderer } = this, { look, show, at } = this.state, full = this.windowCamera();
    for (const canvas of [renderer.canvas, $("marks")]) {
      if (canvas.width === full.size[0] && canvas.height === full.size[1]) continue;
      [canvas.width, canvas.height] = full.size;
      if (canvas === renderer.canvas && renderer.resizeCanvas) renderer.resizeCanvas();
    }
    const split = show === "split" && at !== null && this.photographOf === at ? look.split : 0;
    const mode = show === "split" ? 0 : SHOWS.indexOf(show);
    renderer.develop({ ...look, mode, split }, this.frameOf(full.size));
    if (this.marksShown) this.marks.draw(full, at, density());
    else this.marks.clear();
  }

  frameOf([width, height]) {
    const { lens } = this.state.camera;
    return { scale: 1 / fit(lens, width, height), width: lens.width, height: lens.height };
  }

  say(now, rendered) {
    if (rendered) this.frames.push(now);
    this.frames = this.frames.filter((t) => now - t < 2);
    const { picture, half, extended } = this.renderer;
    const first = this.frames[0], speed = (this.frames.length - 1) / (now - first);
    if (this.frames.length > 2) this.rate = `${speed.toFixed(speed < 10 ? 1 : 0)} frames/s`;
    $("status").textContent = [`${this.splats.count.toLocaleString("en")} Gaussians`,
      `${picture.width} × ${picture.height}`, this.rate, `${half ? 16 : 32}-bit light`,
      extended ? "HDR display" : ""].filter(Boolean).join(" · ");
  }

  writeLink() {
    const link = linkOf(this.state);
    if (link === this.written) return;
    this.written = link;
    // Some browsers forbid this for pages opened from a disk.
    try { history.replaceState(null, "", link); } catch { location.hash = link; }
  }

  // Return a view's exposed radiance under the look, or its radiance if `linear`, as RGBA at the size
  // of the view, rows from the top. Scripts call this.
  async measure(index, linear = false) {
    const view = this.scene.views[index], { R, c, lens } = cameraOf(view);
    const camera = { R, c, lens: [lens.fx, lens.fy, lens.cx, lens.cy] };
    while (this.renderer.waiting) await new Promise((done) => setTimeout(done, 5));
    await this.renderer.sort(camera);
    const target = this.renderer.target();
    this.renderer.render(camera, view.width, view.height, target);
    const frame = { scale: 1, width: view.width, height: view.height };
    if (!linear) this.renderer.develop(this.state.look, frame, target, this.renderer.measured);
    const out = this.renderer.read(linear ? target : this.renderer.measured);
    this.sortedFor = null;
    this.wake();
    return out;
  }

  // Set parts of the look. Scripts call this.
  set(look) {
    Object.assign(this.state.look, look);
    this.show();
  }

  // Return the mean seconds of `count` consecutive frames, without sorting.
  speed(count = 10) {
    const camera = this.windowCamera(), { gl } = this.renderer, pixel = new Uint8Array(4);
    const begin = performance.now();
    for (let k = 0; k < count; k++) {
      this.renderer.render(camera, ...camera.size);
      this.draw();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    }
    return (performance.now() - begin) / 1000 / count;
  }
}

function fill(select, options) {
  for (const [value, label] of options) {
    const option = document.createElement("option");
    Object.assign(option, { value, textContent: label });
    select.append(option);
  }
}

function complain(error) {
  $("status").className = "wrong";
  $("status").setAttribute("role", "alert");
  $("status").textContent = `This page cannot display its scene: ${error.message || error}`;
  throw error;
}

async function open() {
  const scene = JSON.parse($("scene").textContent);
  if (typeof DecompressionStream === "undefined")
    throw new Error("This browser is too old to decompress the scene (no DecompressionStream).");
  const splats = await decodeSplats(scene.splats, $("splats").textContent);
  $("splats").remove();
  const page = new Page(scene, splats);
  await page.ready;
  return page;
}

// Scripts in the console find a promise of the page here.
window.p2gs = open().catch(complain);
