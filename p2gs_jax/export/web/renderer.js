// Renders floating-point radiance: project, sort in a worker, composite back to front, develop.

const ACTIVATIONS = { exp: 0, linear: 1 };
const CURVES = { linear: 0, power: 1, srgb: 2, spline: 3 };
// The radiance of a splat is clamped to this in half precision, whose largest number is 65504.
const HALF_MOST = 6e4;

class Renderer {
  // `precision` is 16 or 32 bits per channel; 32 become 16 if the device cannot blend them.
  constructor(canvas, scene, splats, precision) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false,
      preserveDrawingBuffer: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2.");
    Object.assign(this, { gl, canvas, scene, precision, count: splats.count, order: null, waiting: null });
    this.build(splats);
    this.startSorter(splats.means);
  }

  // Create everything on the graphics device, also after a lost device returns.
  build(splats) {
    const { gl, scene } = this;
    const float = gl.getExtension("EXT_color_buffer_float");
    const blends = float && gl.getExtension("EXT_float_blend");
    if (!float && !gl.getExtension("EXT_color_buffer_half_float"))
      throw new Error("This device cannot render to floating-point textures.");
    this.half = this.precision === 16 || !blends;
    this.extended = this.extendRange();
    this.project = this.program(FULL_SCREEN, PROJECT);
    this.draw = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.developing = this.program(FULL_SCREEN, DEVELOP);
    this.upload(splats);
    this.uploadTables(scene.tone.tables);
    this.photograph = this.texture(gl.TEXTURE_2D, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.empty = gl.createVertexArray();
    this.picture = this.target();
    this.measured = this.target();
    if (this.order) this.setOrder(this.order);
  }

  // Show values above white, if browser and display support them.
  extendRange() {
    const { gl, canvas } = this;
    const offered = gl.drawingBufferStorage && gl.drawingBufferToneMapping &&
      gl.getExtension("EXT_color_buffer_float") && matchMedia("(dynamic-range: high)").matches;
    if (!offered) return false;
    this.resizeCanvas = () => gl.drawingBufferStorage(gl.RGBA16F, canvas.width, canvas.height);
    this.resizeCanvas();
    gl.drawingBufferToneMapping({ mode: "extended" });
    return gl.getError() === gl.NO_ERROR;
  }

  program(vertex, fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
        throw new Error(gl.getShaderInfoLog(shader) || "a shader did not compile");
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(gl.getProgramInfoLog(program));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  texture(kind, filter) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  upload(splats) {
    const { gl } = this;
    const width = Math.min(2048, Math.max(splats.count, 1));
    const height = Math.ceil(splats.count / width);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE))
      throw new Error("This device has not enough memory for the Gaussians.");
    this.table = [width, height];
    this.splats = this.texture(gl.TEXTURE_2D_ARRAY, gl.NEAREST);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGB32F, width, height, splats.triples.length);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    splats.triples.forEach((values, layer) => {
      const padded = new Float32Array(3 * width * height);
      padded.set(values);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, width, height, 1, gl.RGB, gl.FLOAT, padded);
    });
    // Integers hold the bits of floats, because integer targets exist on every device.
    this.columns = [0, 1, 2].map(() => {
      const texture = this.texture(gl.TEXTURE_2D, gl.NEAREST);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, width, height);
      return texture;
    });
    // On devices with at most 256 bits per pixel, each column is projected separately.
    this.projected = this.projections([[0, 1, 2]]) || this.projections([[0], [1], [2]]);
    if (!this.projected) throw new Error("This device cannot render to integer textures.");
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    this.indices = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
  }

  // Return a framebuffer for each group of columns; null if the device does not support one.
  projections(groups) {
    const { gl } = this;
    const made = groups.map((group) => {
      const buffer = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      const places = [0, 1, 2].map((k) => (group.includes(k) ? gl.COLOR_ATTACHMENT0 + k : gl.NONE));
      for (const k of group)
        gl.framebufferTexture2D(gl.FRAMEBUFFER, places[k], gl.TEXTURE_2D, this.columns[k], 0);
      gl.drawBuffers(places);
      return this.complete() ? buffer : null;
    });
    return made.every(Boolean) ? made : null;
  }

  // Return whether the framebuffer can be drawn into; a lost device cannot answer.
  complete() {
    const { gl } = this;
    return gl.isContextLost() || gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
  }

  uploadTables(tables) {
    const { gl } = this;
    this.tables = this.texture(gl.TEXTURE_2D, gl.NEAREST);
    const [height, width] = tables ? [tables.values.length, tables.values[0].length] : [1, 2];
    const values = new Float32Array(tables ? tables.values.flat() : [0, 1]);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, width, height, 0, gl.RED, gl.FLOAT, values);
  }

  setPhotograph(image) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.photograph);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  }

  target() {
    const { gl } = this;
    const texture = this.texture(gl.TEXTURE_2D, gl.NEAREST), buffer = gl.createFramebuffer();
    return { texture, buffer, width: 0, height: 0 };
  }

  resize(target, width, height) {
    const { gl } = this;
    if (target.width === width && target.height === height) return;
    const [format, kind] = this.half ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA32F, gl.FLOAT];
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, kind, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
    Object.assign(target, { width, height });
    if (this.complete()) return;
    if (this.half) throw new Error(`This device cannot render light of ${width} × ${height} pixels.`);
    this.half = true;
    target.width = 0;
    this.resize(target, width, height);
  }

  startSorter(means) {
    const source = document.getElementById("sorter").textContent;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.worker.onmessage = ({ data }) => {
      this.setOrder(data.order);
      const { row, done } = this.waiting;
      this.waiting = null;
      done(row);
    };
    const copy = means.slice();
    this.worker.postMessage({ means: copy, near: this.scene.render.near }, [copy.buffer]);
  }

  setOrder(order) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.order = order;
  }

  // Return a promise of the order for a camera, or null while another sort runs.
  sort(camera) {
    if (this.waiting) return null;
    const R = camera.R, c = camera.c;
    const row = [R[6], R[7], R[8], -(R[6] * c[0] + R[7] * c[1] + R[8] * c[2])];
    return new Promise((done) => {
      this.waiting = { row, done };
      this.worker.postMessage({ row });
    });
  }

  // Render the radiance of a camera {R, c, lens: [fx, fy, cx, cy]} into a target; row 0 is the top.
  render(camera, width, height, target = this.picture) {
    const { gl, scene } = this, r = scene.render;
    const [p, d] = [this.project, this.draw];
    gl.disable(gl.BLEND);
    gl.viewport(0, 0, ...this.table);
    gl.useProgram(p.program);
    gl.bindVertexArray(this.empty);
    this.bind(p, "splats", 0, this.splats, gl.TEXTURE_2D_ARRAY);
    gl.uniform1i(p.at.count, this.count);
    gl.uniform1i(p.at.coefficients, scene.splats.coefficients);
    gl.uniform1i(p.at.activation, ACTIVATIONS[r.radiance]);
    gl.uniformMatrix3fv(p.at.rotation, true, camera.R);
    gl.uniform3fv(p.at.centre, camera.c);
    gl.uniform4fv(p.at.lens, camera.lens);
    gl.uniform2f(p.at.size, width, height);
    for (const name of ["near", "blur", "logCutoff"])
      gl.uniform1f(p.at[name], r[name]);
    for (const buffer of this.projected) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    this.resize(target, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!this.order || !this.order.length) return;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(d.program);
    gl.bindVertexArray(this.quads);
    ["place", "shape", "light"].forEach((name, k) =>
      this.bind(d, name, k, this.columns[k], gl.TEXTURE_2D));
    gl.uniform2f(d.at.size, width, height);
    gl.uniform1f(d.at.alphaMax, r.alphaMax);
    gl.uniform1f(d.at.brightest, this.half ? HALF_MOST : 3e38);  // the latter: float32
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.order.length);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  bind(program, name, unit, texture, kind) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.uniform1i(program.at[name], unit);
  }

  // Develop a rendered target onto the canvas, or write its exposed radiance into the target `into`.
  develop(look, frame, target = this.picture, into = null) {
    const { gl, canvas, scene } = this, p = this.developing;
    const [width, height] = into ? [target.width, target.height] : [canvas.width, canvas.height];
    if (into) this.resize(into, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, into ? into.buffer : null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(p.program);
    gl.bindVertexArray(this.empty);
    this.bind(p, "linear", 0, target.texture, gl.TEXTURE_2D);
    this.bind(p, "tables", 1, this.tables, gl.TEXTURE_2D);
    this.bind(p, "photograph", 2, this.photograph, gl.TEXTURE_2D);
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform2f(p.at.pictureSize, target.width, target.height);
    gl.uniform2f(p.at.canvasSize, width, height);
    gl.uniform3fv(p.at.factors, factorsOf(look, scene));
    gl.uniform1i(p.at.mode, into ? 3 : look.mode);
    gl.uniform1i(p.at.curve, CURVES[look.curve]);
    gl.uniform1f(p.at.gamma, look.gamma);
    gl.uniform1f(p.at.pivot, scene.tone.pivot);
    gl.uniform1f(p.at.white, 2 ** look.white);
    const tables = tableRows(look, scene);
    gl.uniform3fv(p.at.curveWhite, whiteOf(look, scene, tables));
    gl.uniform3iv(p.at.tableRow, tables.rows);
    gl.uniform3fv(p.at.tableFirst, tables.first);
    gl.uniform3fv(p.at.tableStep, tables.step);
    const shade = look.vignetting && look.camera >= 0 ? scene.tone.cameras[look.camera] : null;
    gl.uniformMatrix3fv(p.at.vignetting, false, vignettingOf(shade));
    gl.uniform3f(p.at.frame, frame.scale, frame.width, frame.height);
    gl.uniform1f(p.at.split, into ? 0 : look.split);
    gl.uniform1f(p.at.most, this.extended && look.hdr ? 16 : 1);
    gl.uniform3fv(p.at.stopColors, scene.stopColors.flat());
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Return the RGBA of a target, rows from the top.
  read(target) {
    const { gl } = this, out = new Float32Array(4 * target.width * target.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readPixels(0, 0, target.width, target.height, gl.RGBA, gl.FLOAT, out);
    return out;
  }
}

// Return exposure times white balance of each channel.
function factorsOf(look, scene) {
  return look.balance.map((b) => scene.look.exposure * 2 ** look.ev * Math.exp(b));
}

function tableRows(look, scene) {
  const tables = scene.tone.tables;
  if (!tables) return { rows: [0, 0, 0], first: [0, 0, 0], step: [1, 1, 1] };
  const cameras = tables.values.length / tables.channels;
  const camera = look.camera >= 0 && cameras > 1 ? look.camera : cameras - 1;
  const rows = [0, 1, 2].map((k) => camera * tables.channels + (tables.channels > 1 ? k : 0));
  return { rows, first: rows.map((r) => tables.first[r]), step: rows.map((r) => tables.step[r]) };
}

// Return the exposed radiance that each channel's curve shows as 1.
function whiteOf(look, scene, tables) {
  const { pivot } = scene.tone;
  const last = scene.tone.tables ? scene.tone.tables.values[0].length - 1 : 0;
  return [0, 1, 2].map((k) => {
    const top = look.curve === "spline" ? tables.first[k] + last * tables.step[k] : 0;
    return pivot * (Math.exp(top) / pivot) ** (look.gamma / 2.2);
  });
}

function vignettingOf(rows) {
  const out = new Float32Array(9);
  if (rows && rows.length)
    for (let k = 0; k < 3; k++) out.set(rows[rows.length > 1 ? k : 0].slice(0, 3), 3 * k);
  return out;
}
