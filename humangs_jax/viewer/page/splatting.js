// Drawing: Gaussians in depth order become splats in textures (project.frag), splats are blended
// front to back in 16-bit floats (splat.*), and the result is laid over the background
// (background.*).

const MOST_JOINTS = 256;  // of the uniform block in project.frag

function makeRenderer(canvas, scene) {
  const gl = canvas.getContext("webgl2", { antialias: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("WebGL 2 is missing.");
  // without this extension splats are added up in 8 bits, which shows banding but gives a picture
  const floats = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");

  const { count, header } = scene, how = header.splatting;
  const light = header.light ?? Array(8).fill(0), shading = header.light_shading ?? { low: 0, high: 0 };
  const source = (id) => document.getElementById(id).textContent.trim();
  const project = makeProgram(gl, source("whole.vert"), source("project.frag"));
  const draw = makeProgram(gl, source("splat.vert"), source("splat.frag"));
  const over = makeProgram(gl, source("whole.vert"), source("background.frag"));

  const gaussians = makeTexture(gl, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, gaussianTexels(scene));
  const means = makeTexture(gl, gl.RGBA32F, gl.RGBA, gl.FLOAT, meanTexels(scene));
  const harmonics = scene.arrays.harmonics ? makeTexture(gl, gl.RGBA32F, gl.RGBA, gl.FLOAT, harmonicTexels(scene)) : null;
  const functions = harmonics ? scene.arrays.harmonics.length / (3 * count) : 0;
  const joints = gl.createBuffer();
  gl.bindBuffer(gl.UNIFORM_BUFFER, joints);
  gl.bufferData(gl.UNIFORM_BUFFER, 16 * 3 * MOST_JOINTS, gl.DYNAMIC_DRAW);
  gl.uniformBlockBinding(project.program, gl.getUniformBlockIndex(project.program, "Joints"), 0);
  const image = gl.createTexture(), target = gl.createFramebuffer();
  let imageSize = [0, 0];

  const splatRows = Math.ceil(count / ROW), splatTextures = [0, 1, 2].map(() =>
    makeTexture(gl, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, { data: null, width: ROW, height: splatRows }));
  const order = makeTexture(gl, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, { data: null, width: ROW, height: splatRows });
  const padded = new Uint32Array(ROW * splatRows);
  const projected = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, projected);
  const outputs = splatTextures.map((texture, i) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    return gl.COLOR_ATTACHMENT0 + i;
  });
  gl.drawBuffers(outputs);

  // two triangles per splat; no instances, because software and some GPUs draw instances one by one
  const corners = new Uint32Array(6 * count), rectangles = gl.createVertexArray(), nothing = gl.createVertexArray();
  for (let i = 0; i < count; i++) corners.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner), 6 * i);
  gl.bindVertexArray(rectangles);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  gl.bindVertexArray(null);

  function fitImage(width, height) {
    if (imageSize[0] === width && imageSize[1] === height) return;
    imageSize = [width, height];
    gl.bindTexture(gl.TEXTURE_2D, image);
    if (floats) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    unfiltered(gl);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
  }

  // Draws an image. camera: see camera.js. rows: joint transforms, Float32Array (12 j). look: {
  // background, transparent, ground, floor, shadows, middle }.
  function render(camera, rows, look) {
    const { width, height } = camera;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    fitImage(width, height);

    gl.useProgram(project.program);
    [order, gaussians, means, harmonics ?? means].forEach((texture, unit) => bind(gl, unit, texture));
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, joints);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, rows);
    project.set({
      order: 0, gaussians: 1, means: 2, harmonics: 3, functions, rows: splatRows, count, camera_rotation: camera.rotation, camera_offset: camera.translation, K: camera.K,
      size: [width, height], log_scale: [header.scales.low, header.scales.high],
      color_range: [header.colors.low, header.colors.high], near: how.near, eps2d: how.eps2d, low_pass: how.low_pass, alpha_min: how.alpha_min,
      first_light: light.slice(0, 3), more_light: light.slice(3, 6), last_light: light.slice(6), shading_range: [shading.low, shading.high],
      jacobian_margin: how.jacobian_margin ?? -1, rotation_only: header.skinning === "rotation" ? 1 : 0,
    });
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, projected);
    gl.viewport(0, 0, ROW, splatRows);
    gl.bindVertexArray(nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.useProgram(draw.program);
    splatTextures.forEach((texture, unit) => bind(gl, unit, texture));
    draw.set({ placed_splats: 0, shape_splats: 1, color_splats: 2, size: [width, height], alpha_min: how.alpha_min, alpha_max: how.alpha_max });
    gl.bindVertexArray(rectangles);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(over.program);
    bind(gl, 0, image);
    over.set({
      splats: 0, background: look.background, opaque: look.transparent ? 0 : 1,
      ground: look.ground, floor_height: look.floor, eye: camera.eye,
      camera_rotation: camera.rotation, K: camera.K, size: [width, height], shadows: look.shadows.flat(), middle: look.middle,
    });
    gl.bindVertexArray(nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  return {
    gl, render, floats: Boolean(floats),
    longestSide: Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), ...gl.getParameter(gl.MAX_VIEWPORT_DIMS)),
    setOrder(indices) {
      padded.set(indices);
      bind(gl, 0, order);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, splatRows, gl.RED_INTEGER, gl.UNSIGNED_INT, padded);
    },
    setMeans() {
      const { data, width, height } = meanTexels(scene);
      bind(gl, 1, means);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT, data);
    },
    // Waits until the GPU has drawn, by reading a pixel back.
    finish() {
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    },
  };
}

function makeProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
      throw new Error(`shader: ${gl.getShaderInfoLog(shader)}`);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
    throw new Error(`shader program: ${gl.getProgramInfoLog(program)}`);
  const setters = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name, type } = gl.getActiveUniform(program, i), at = gl.getUniformLocation(program, name);
    if (!at) continue;  // of a block
    setters[name.replace("[0]", "")] = {
      [gl.FLOAT]: (v) => gl.uniform1f(at, v), [gl.FLOAT_VEC2]: (v) => gl.uniform2fv(at, v),
      [gl.FLOAT_VEC3]: (v) => gl.uniform3fv(at, v), [gl.FLOAT_VEC4]: (v) => gl.uniform4fv(at, v),
      [gl.FLOAT_MAT3]: (v) => gl.uniformMatrix3fv(at, true, v),  // ours are row-major
    }[type] || ((v) => gl.uniform1i(at, v));
  }
  return { program, set: (values) => { for (const [name, value] of Object.entries(values)) setters[name]?.(value); } };
}

function makeTexture(gl, format, layout, type, { data, width, height }) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, type, data);
  unfiltered(gl);
  return texture;
}

function unfiltered(gl) {
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
}

function bind(gl, unit, texture) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
}
