// The cameras of photographs, drawn over the picture as pyramids coloured by exposure.

class Marks {
  constructor(canvas, scene) {
    Object.assign(this, { canvas, scene, at: [] });
    this.cameras = scene.views.map(cameraOf);
    const steps = this.cameras.slice(1).map((b, i) => length(plus(b.c, this.cameras[i].c, -1)));
    const sorted = steps.filter((s) => s > 0).sort((a, b) => a - b);
    this.size = 0.35 * (sorted[Math.floor(sorted.length / 2)] || 0.1 * scene.depth);
    const evs = scene.views.map((v) => v.ev);
    [this.low, this.high] = [Math.min(...evs), Math.max(...evs)];
  }

  color(view) {
    const colors = this.scene.stopColors, span = this.high - this.low;
    const share = span > 1e-6 ? (view.ev - this.low) / span : 0.5;
    const rgb = colors[Math.round(share * (colors.length - 1))].map((v) => Math.round(255 * v));
    return `rgb(${rgb.join(" ")})`;
  }

  draw(camera, here, pixels) {
    const pen = this.canvas.getContext("2d");
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.at = [];
    this.cameras.forEach((drawn, index) => {
      if (index === here) return;
      const { R, c, lens } = drawn, d = this.size;
      const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
        const pinhole = { R, c, lens: [lens.fx, lens.fy, lens.cx, lens.cy] };
        return projectPoint(camera, pointAt(pinhole, u * lens.width, v * lens.height, d));
      });
      const tip = projectPoint(camera, c);
      if ([tip, ...corners].some((p) => !(p[2] > 0.05))) return;
      this.at.push({ index, x: tip[0], y: tip[1], z: tip[2] });
      pen.beginPath();
      corners.forEach((p, k) => {
        pen.moveTo(tip[0], tip[1]);
        pen.lineTo(p[0], p[1]);
        pen.lineTo(...corners[(k + 1) % 4].slice(0, 2));
      });
      pen.lineWidth = 3 * pixels;
      pen.strokeStyle = "rgb(0 0 0 / 45%)";
      pen.stroke();
      pen.lineWidth = 1.5 * pixels;
      pen.strokeStyle = this.color(this.scene.views[index]);
      pen.stroke();
    });
  }

  clear() {
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.at = [];
  }

  // Return the row of the nearest camera whose mark is within `reach` pixels of (x, y), or null.
  find(x, y, reach) {
    const near = this.at.filter((m) => Math.hypot(m.x - x, m.y - y) < reach);
    return near.length ? near.reduce((a, b) => (a.z < b.z ? a : b)).index : null;
  }
}
