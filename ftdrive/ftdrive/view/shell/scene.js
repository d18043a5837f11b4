// The cell in three dimensions: bodies of revolution, boxes, lines, dots and arrows in WebGL 2, and an orbiting camera.
"use strict";

const scene = (() => {
  const canvas = document.querySelector("#scene canvas"), labels = document.getElementById("labels");
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  const parts = new Map(), shapes = new Map(), names = new Map();
  const view = { at: [0, 0, 0.3], away: 2.5, azimuth: 0.8, height: 0.5, set: false };
  let due = false, home = null;

  // Vectors and 4 x 4 matrices by columns.
  const add = (a, b, k = 1) => a.map((x, i) => x + k * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = a => { const n = Math.hypot(...a) || 1; return a.map(x => x / n); };
  function rotation([w, x, y, z]) {
    return [[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]];
  }
  function placed(at = [0, 0, 0], turn = [1, 0, 0, 0], size = [1, 1, 1]) {
    const R = rotation(turn);
    return [...R.flatMap((column, i) => [...column.map(x => x * size[i]), 0]), ...at, 1];
  }
  function times(A, B) {
    const C = new Array(16).fill(0);
    for (let j = 0; j < 4; j++) for (let i = 0; i < 4; i++) for (let k = 0; k < 4; k++) C[4 * j + i] += A[4 * k + i] * B[4 * j + k];
    return C;
  }
  function turnTo(axis) {  // the rotation, as columns, that turns z into an axis
    const z = unit(axis), x = unit(cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z));
    return [x, cross(z, x), z];
  }

  // Shapes: triangles with a normal at each corner.
  function revolved(outline, facets = 48) {  // outline: radius, height and normal (radial, along z) of pairs of corners
    const data = [];
    for (let i = 0; i < facets; i++) {
      const turns = [i, i + 1].map(k => [Math.cos(2 * Math.PI * k / facets), Math.sin(2 * Math.PI * k / facets)]);
      for (const [a, b] of outline) {
        const corner = ([r, h, nr, nz], [c, s]) => data.push(r * c, r * s, h, nr * c, nr * s, nz);
        corner(a, turns[0]); corner(a, turns[1]); corner(b, turns[1]);
        corner(a, turns[0]); corner(b, turns[1]); corner(b, turns[0]);
      }
    }
    return data;
  }
  function roundedCylinder(half, radius, rounding) {
    const quarter = Array.from({ length: 13 }, (_, i) => i * Math.PI / 24), outline = [];
    const arc = quarter.map(a => [radius + rounding * Math.cos(a), half + rounding * Math.sin(a), Math.cos(a), Math.sin(a)]);
    const top = half + rounding;
    outline.push([[0, -top, 0, -1], [radius, -top, 0, -1]]);
    const below = arc.map(([r, h, nr, nz]) => [r, -h, nr, -nz]).reverse();
    for (const side of [below, arc]) for (let i = 0; i < 12 && rounding; i++) outline.push([side[i], side[i + 1]]);
    const wall = radius + rounding;
    outline.push([[wall, -half, 1, 0], [wall, half, 1, 0]], [[radius, top, 0, 1], [0, top, 0, 1]]);
    return revolved(outline);
  }
  function cube() {
    const data = [];
    for (let axis = 0; axis < 3; axis++) for (const sign of [-1, 1]) {
      const corner = (u, v) => { const p = [0, 0, 0], n = [0, 0, 0]; p[axis] = sign / 2; n[axis] = sign;
        p[(axis + 1) % 3] = u * sign / 2; p[(axis + 2) % 3] = v / 2; data.push(...p, ...n); };
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) corner(u, v);
    }
    return data;
  }
  function shape(key, data) {
    if (!shapes.has(key)) {
      const array = gl.createVertexArray(), values = new Float32Array(data());
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      for (const place of [0, 1]) { gl.enableVertexAttribArray(place); gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 24, 12 * place); }
      shapes.set(key, { array, count: values.length / 6 });
    }
    return shapes.get(key);
  }

  // Programs: lit bodies; lines as ribbons of some pixels; round dots.
  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${text}`);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  }
  const place = (made, name) => gl.getUniformLocation(made, name);
  let bodies, ribbons, round;
  if (gl) {
    bodies = program(
      `layout(location=0) in vec3 p; layout(location=1) in vec3 n; uniform mat4 M, V; out vec3 normal;
       void main() { normal = transpose(inverse(mat3(M))) * n; gl_Position = V * M * vec4(p, 1.); }`,
      `in vec3 normal; uniform vec4 colour; uniform vec3 eye; out vec4 o;
       void main() { vec3 n = normalize(normal); float light = .5 + .35 * max(dot(n, normalize(vec3(.4, .3, .85))), 0.) + .2 * abs(dot(n, eye));
       o = vec4(colour.rgb * light * colour.a, colour.a); }`);
    ribbons = program(
      `layout(location=0) in vec3 a; layout(location=1) in vec3 b; layout(location=2) in vec2 side; uniform mat4 V; uniform vec2 screen; uniform float width;
       void main() { vec4 A = V * vec4(a, 1.), B = V * vec4(b, 1.); vec2 d = (B.xy / B.w - A.xy / A.w) * screen;
       d = length(d) > 0. ? normalize(d) : vec2(1, 0); vec4 P = side.x < .5 ? A : B;
       gl_Position = P + vec4(vec2(-d.y, d.x) * side.y * width / screen * P.w, 0, 0); }`,
      `uniform vec4 colour; out vec4 o; void main() { o = vec4(colour.rgb * colour.a, colour.a); }`);
    round = program(
      `layout(location=0) in vec3 p; layout(location=1) in vec3 c; uniform mat4 V; uniform float size; out vec3 colour;
       void main() { colour = c; gl_Position = V * vec4(p, 1.); gl_PointSize = size; }`,
      `in vec3 colour; out vec4 o; void main() { if (length(gl_PointCoord - .5) > .5) discard; o = vec4(colour, 1); }`);
  } else labels.append(Object.assign(document.createElement("span"), { textContent: "This browser has no WebGL: nothing is drawn here." }));
  const scratch = gl && [gl.createVertexArray(), gl.createBuffer()];
  const stream = (data, sizes) => {
    const stride = 4 * sizes.reduce((a, b) => a + b);
    gl.bindVertexArray(scratch[0]);
    gl.bindBuffer(gl.ARRAY_BUFFER, scratch[1]);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.STREAM_DRAW);
    sizes.reduce((offset, size, i) => { gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, size, gl.FLOAT, false, stride, offset); return offset + 4 * size; }, 0);
    gl.drawArrays(sizes.length === 2 ? gl.POINTS : gl.TRIANGLES, 0, 4 * data.length / stride);
  };

  const known = new Map();
  function colour(name) {
    if (!known.has(name)) {
      const hex = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim().replace("#", "");
      const full = hex.length === 3 ? [...hex].map(c => c + c).join("") : hex;
      known.set(name, [0, 2, 4].map(i => parseInt(full.slice(i, i + 2), 16) / 255));
    }
    return known.get(name);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { known.clear(); later(); });

  // The camera: z is up.
  const towards = () => [Math.cos(view.height) * Math.cos(view.azimuth), Math.cos(view.height) * Math.sin(view.azimuth), Math.sin(view.height)];
  function camera() {
    const back = towards(), right = [-Math.sin(view.azimuth), Math.cos(view.azimuth), 0], up = cross(back, right);
    const eye = add(view.at, back, view.away), near = view.away / 50, far = view.away + 20, f = 2.2, aspect = canvas.width / canvas.height;
    const look = [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0, -dot(right, eye), -dot(up, eye), -dot(back, eye), 1];
    const wide = Math.min(1, aspect);
    const lens = [f * wide / aspect, 0, 0, 0, 0, f * wide, 0, 0, 0, 0, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0];
    return { V: times(lens, look), right, up, back };
  }
  function look({ at, from }) {
    const d = add(from, at, -1), away = Math.hypot(...d);
    Object.assign(view, { at, away, azimuth: Math.atan2(d[1], d[0]), height: Math.asin(d[2] / away) });
    later();
  }
  const seen = (azimuth, height) => () => { Object.assign(view, { azimuth, height }); if (home) { view.at = home.at; view.away = Math.hypot(...add(home.from, home.at, -1)); } later(); };
  function along() {
    const arm = [...parts.values()].find(part => part.kind === "along");
    if (!arm) return;
    const d = unit(arm.axis), height = Math.asin(Math.max(-1, Math.min(1, d[2])));
    Object.assign(view, { at: arm.at, away: 1.0, height, azimuth: Math.abs(d[2]) > 0.999 ? view.azimuth : Math.atan2(d[1], d[0]) });
    later();
  }
  const presets = { Start: () => home && look(home), Front: seen(0, 0.05), Side: seen(-Math.PI / 2, 0.05), Top: seen(0, Math.PI / 2), "Along the tool": along };
  for (const [words, act] of Object.entries(presets)) {
    const button = document.createElement("button");
    button.textContent = words;
    button.onclick = act;
    document.getElementById("presets").append(button);
  }

  const fingers = new Map();
  const spread = () => { const [a, b] = [...fingers.values()]; return { away: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2] }; };
  function pan(dx, dy) { const { right, up } = camera(), k = view.away / 2.2 / canvas.clientHeight * 2; view.at = add(add(view.at, right, -dx * k), up, dy * k); }
  canvas.onpointerdown = event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]); };
  canvas.onpointermove = event => {
    if (!fingers.has(event.pointerId)) return;
    const [x, y] = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
    if (fingers.size === 2) {
      const before = spread();
      fingers.set(event.pointerId, now);
      const after = spread();
      zoom(before.away / Math.max(after.away, 1));
      pan(after.middle[0] - before.middle[0], after.middle[1] - before.middle[1]);
    } else if (event.buttons === 2 || event.shiftKey) pan(now[0] - x, now[1] - y);
    else { view.azimuth -= (now[0] - x) * 0.008; view.height = Math.max(-1.57, Math.min(1.57, view.height + (now[1] - y) * 0.008)); }
    fingers.set(event.pointerId, now);
    later();
  };
  canvas.onpointerup = canvas.onpointercancel = event => fingers.delete(event.pointerId);
  canvas.oncontextmenu = event => event.preventDefault();
  const zoom = k => { view.away = Math.max(0.2, Math.min(15, view.away * k)); later(); };
  canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
  canvas.onkeydown = event => {
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (turn) { view.azimuth += turn[0]; view.height = Math.max(-1.57, Math.min(1.57, view.height + turn[1])); event.preventDefault(); later(); }
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.9 : 1.1);
  };

  // What one part is drawn as: solids, lines and dots.
  function solids(part) {
    const key = part.kind === "body" ? `body ${part.shape}` : part.kind;
    const data = () => part.kind === "body" ? roundedCylinder(...part.shape) : cube();
    const alpha = part.alpha ?? 1, copies = part.copies ?? [[...(part.at ?? [0, 0, 0]), ...(part.turn ?? [1, 0, 0, 0])]];
    return copies.map(one => ({ key, data, M: placed(one.slice(0, 3), one.slice(3), part.size), colour: [...colour(part.colour), alpha], at: one.slice(0, 3) }));
  }
  function arrow({ ends: [a, b], colour: name }) {
    const d = add(b, a, -1), length = Math.hypot(...d), tip = Math.min(0.05, length), R = turnTo(d), shaft = length - tip;
    const M = (at, sizes) => [...R.flatMap((column, i) => [...column.map(x => x * sizes[i]), 0]), ...at, 1];
    const cone = () => revolved([[[0, 0, 0, -1], [1, 0, 0, -1]], [[1, 0, 0.9, 0.4], [0, 1, 0.9, 0.4]]]);
    const rod = () => revolved([[[1, 0, 1, 0], [1, 1, 1, 0]]]);
    return [{ key: "rod", data: rod, M: M(a, [0.008, 0.008, shaft]) }, { key: "cone", data: cone, M: M(add(a, unit(d), shaft), [0.022, 0.022, tip]) }]
      .map(one => ({ ...one, colour: [...colour(name), 1], at: a }));
  }
  function axisEnds(part) {
    const R = rotation(part.turn);
    return R.map(column => add(part.at, column, part.length));
  }

  function later() { if (!due) { due = true; requestAnimationFrame(render); } }
  function render() {
    due = false;
    const dpr = Math.min(devicePixelRatio, 2), width = Math.round(canvas.clientWidth * dpr), height = Math.round(canvas.clientHeight * dpr);
    if (!gl || !width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const { V, back } = camera(), solid = [], lines = [], texts = [];
    for (const [name, part] of parts) {
      if (part.kind === "body" || part.kind === "box") solid.push(...solids(part));
      if (part.kind === "arrow") solid.push(...arrow(part));
      if (part.kind === "path") lines.push({ points: part.points, colour: part.colour });
      if (part.kind === "axes") axisEnds(part).forEach((end, i) => {
        lines.push({ points: [part.at, end], colour: "xyz"[i] });
        if (part.named) texts.push([`${name} ${i}`, `+${"xyz"[i]}`, end]);
      });
      if (part.kind === "label") texts.push([name, part.text, part.at]);
    }
    gl.useProgram(bodies);
    gl.uniformMatrix4fv(place(bodies, "V"), false, V);
    gl.uniform3fv(place(bodies, "eye"), back);
    // What is transparent is drawn last, from behind, and hides nothing.
    const [clear, opaque] = [solid.filter(one => one.colour[3] < 1), solid.filter(one => one.colour[3] === 1)];
    clear.sort((a, b) => dot(a.at, back) - dot(b.at, back));
    const fill = one => {
      const { array, count } = shape(one.key, one.data);
      gl.bindVertexArray(array);
      gl.uniformMatrix4fv(place(bodies, "M"), false, one.M);
      gl.uniform4fv(place(bodies, "colour"), one.colour);
      gl.drawArrays(gl.TRIANGLES, 0, count);
    };
    opaque.forEach(fill);
    gl.useProgram(ribbons);
    gl.uniformMatrix4fv(place(ribbons, "V"), false, V);
    gl.uniform2f(place(ribbons, "screen"), width, height);
    gl.uniform1f(place(ribbons, "width"), 3 * dpr);
    for (const line of lines) {
      gl.uniform4fv(place(ribbons, "colour"), [...colour(line.colour), 1]);
      stream(line.points.slice(1).flatMap((b, i) => [[0, -1], [0, 1], [1, 1], [0, -1], [1, 1], [1, -1]].flatMap(side => [...line.points[i], ...b, ...side])), [3, 3, 2]);
    }
    gl.useProgram(round);
    gl.uniformMatrix4fv(place(round, "V"), false, V);
    gl.uniform1f(place(round, "size"), 11 * dpr);
    for (const part of parts.values()) {
      if (part.kind === "dots" && part.points.length) stream(part.points.flatMap((p, i) => [...add(part.at, p), ...colour(part.colours[i])]), [3, 3]);
    }
    gl.useProgram(bodies);
    gl.depthMask(false);
    gl.enable(gl.CULL_FACE);
    clear.forEach(fill);
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);
    write(texts, V);
  }
  function write(texts, V) {
    for (const [key, element] of names) if (!texts.some(([other]) => other === key)) { element.remove(); names.delete(key); }
    for (const [key, text, [x, y, z]] of texts) {
      if (!names.has(key)) names.set(key, labels.appendChild(document.createElement("span")));
      const element = names.get(key), [X, Y, , W] = [0, 1, 2, 3].map(i => V[i] * x + V[4 + i] * y + V[8 + i] * z + V[12 + i]);
      element.textContent = text;
      element.hidden = W <= 0;
      element.style.transform = `translate(-50%, -50%) translate(${(X / W + 1) / 2 * canvas.clientWidth}px, ${(1 - Y / W) / 2 * canvas.clientHeight}px)`;
    }
  }
  new ResizeObserver(later).observe(canvas);

  function put(name, part) {
    if (part?.kind === "camera") { if (!view.set) look(part); view.set = true; home = part; return; }
    if (part?.kind === "legend") {
      document.getElementById("legend").replaceChildren(...part.rows.map(([name, mark, words]) => {
        const row = document.createElement("li"), sign = document.createElement("i");
        sign.className = mark;
        sign.style.background = `var(--${name})`;
        row.append(sign, words);
        return row;
      }));
      return;
    }
    if (part) parts.set(name, part); else parts.delete(name);
    later();
  }
  return { put };
})();
