// The 3-D view of a page: surfaces in the colours of what is known of them, lines, standard views, places to go to.
//
// Everything is drawn by three.js in the occlusal frame (mm) with an orthographic camera, so that the length bar holds
// everywhere. What to draw stands in the element #scene; arrays are base64 of gzip of little-endian numbers. A picture
// is drawn only when something changed.
"use strict";
(async () => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const lengthUnit = scene.length_unit ?? "mm"; // Photographs alone tell no scale.
  const root = document.getElementById("viewer");
  const find = (selector) => root.querySelector(selector);
  const canvas = find("canvas");
  const still = find(".still");
  const UNKNOWN = -32768;
  const ACCENT = 0xd9480f;

  // --- reading -------------------------------------------------------------------------------------------------------

  const types = { Float32Array, Uint32Array, Uint16Array, Int16Array, Uint8Array };

  async function unpack({ type, data }) {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new types[type](await new Response(stream).arrayBuffer());
  }

  const linear = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);

  // --- drawing -------------------------------------------------------------------------------------------------------

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    if (typeof DecompressionStream === "undefined") throw new Error("too old");
  } catch {
    find(".loading").textContent = "This browser cannot draw in 3-D; a picture is shown instead.";
    return;
  }
  const world = new THREE.Scene();
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0.1, 2000);
  const light = new THREE.DirectionalLight(0xffffff, 1.9);
  light.position.set(-0.45, 0.6, 0.66);
  camera.add(light);
  world.add(camera, new THREE.HemisphereLight(0xffffff, 0xd8dde2, 1.75));
  const controls = new THREE.TrackballControls(camera, canvas);
  Object.assign(controls, { rotateSpeed: 3.2, zoomSpeed: 1.4, panSpeed: 0.5, staticMoving: true });

  const layers = new Map();
  const scales = new Map(scene.scales.map((each) => [each.name, each]));
  let scale = scene.scales[0] ?? null; // What colours tell; null for none.
  let dirty = true;
  let snapshotTimer = 0;

  function surfaceMaterial(layer) {
    const behind = layer.behind ? { polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 3000 } : {};
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide, ...behind });
    material.onBeforeCompile = (shader) => {
      const grey = "#include <color_fragment>\nif (!gl_FrontFacing) diffuseColor.rgb = vec3(0.36);";
      shader.fragmentShader = shader.fragmentShader.replace("#include <color_fragment>", grey);
    };
    return material;
  }

  async function addMesh(layer) {
    const [steps, faces] = await Promise.all([unpack(layer.vertices), unpack(layer.faces)]);
    const positions = new Float32Array(steps.length);
    for (let k = 0; k < steps.length; k++) positions[k] = layer.origin[k % 3] + layer.step * steps[k];
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(steps.length), 3));
    geometry.setIndex(new THREE.BufferAttribute(faces, 1));
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    const object = new THREE.Mesh(geometry, surfaceMaterial(layer));
    const values = {};
    for (const name of Object.keys(layer.values)) values[name] = await unpack(layer.values[name]);
    object.userData = { values, color: layer.color };
    return object;
  }

  async function addLines(layer) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(await unpack(layer.points), 3));
    if (layer.kind === "segments") {
      const look = { color: 0x1c5d99, transparent: true, opacity: 0.45 };
      return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial(look));
    }
    const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: 0xb5179e }));
    line.add(new THREE.Points(geometry, new THREE.PointsMaterial({ color: 0xb5179e, size: 6, sizeAttenuation: false })));
    return line;
  }

  for (const each of scene.scales) each.bar = Array.from(await unpack(each.colors), (value) => linear(value / 255));

  function shareOf(value, { end, signed, per_step: step }) {
    const share = (value * step) / end;
    return Math.min(1, Math.max(0, signed ? 0.5 + 0.5 * share : share));
  }

  function paint(object) {
    const { color } = object.userData;
    const values = scale && object.userData.values[scale.name];
    const colors = object.geometry.attributes.color;
    const plain = color.map((value) => linear(value / 255));
    const grey = linear(168 / 255);
    for (let k = 0; k < colors.count; k++) {
      if (!values) {
        colors.setXYZ(k, ...plain);
      } else if (values[k] === UNKNOWN) {
        colors.setXYZ(k, grey, grey, grey);
      } else {
        const at = 3 * Math.round((scale.bar.length / 3 - 1) * shareOf(values[k], scale));
        colors.setXYZ(k, scale.bar[at], scale.bar[at + 1], scale.bar[at + 2]);
      }
    }
    colors.needsUpdate = true;
  }

  function draw() {
    if (!dirty) return;
    dirty = false;
    renderer.render(world, camera);
    placeOverlays();
    showLength();
    clearTimeout(snapshotTimer);
    snapshotTimer = setTimeout(snapshot, 400);
  }

  // The picture that is printed: it is made smaller there, so the length bar must be part of it.
  function snapshot() {
    renderer.render(world, camera);
    const picture = document.createElement("canvas");
    [picture.width, picture.height] = [canvas.width, canvas.height];
    const pen = picture.getContext("2d");
    pen.drawImage(canvas, 0, 0);
    const scale = renderer.getPixelRatio(); // The page may be laid out for paper already, where the view has no size.
    const bar = parseFloat(find(".length span").style.width) * scale;
    const [left, bottom, size] = [14 * scale, picture.height - 14 * scale, 14 * scale];
    pen.fillRect(left, bottom - 0.3 * size, bar, 0.14 * size);
    pen.font = `600 ${size}px sans-serif`;
    pen.fillText(find(".length b").textContent, left + bar + 0.4 * size, bottom);
    still.src = picture.toDataURL("image/png");
  }

  function change() {
    dirty = true;
  }

  // --- the view ------------------------------------------------------------------------------------------------------

  let half = 10;
  let chosen = null;
  let home = null; // The standard view that is shown, until it is turned, moved or left.

  function resize() {
    const { clientWidth: width, clientHeight: height } = canvas.parentElement;
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    renderer.setSize(width, height, false);
    const across = half * Math.max(1, width / height);
    const above = half * Math.max(1, height / width);
    Object.assign(camera, { left: -across, right: across, top: above, bottom: -above });
    camera.updateProjectionMatrix();
    controls.handleResize();
    change();
  }

  function lookAt(target, eye, up, size) {
    half = size;
    camera.zoom = 1;
    controls.target.copy(target);
    camera.position.copy(target).addScaledVector(eye.clone().normalize(), 500);
    camera.up.copy(up);
    camera.lookAt(target);
    resize();
    controls.update();
    change();
  }

  const vector = (values) => new THREE.Vector3(...values);

  function whole(name = scene.views[0].name) {
    home = name;
    const view = scene.views.find((each) => each.name === name);
    const eye = vector(view.eye).normalize();
    const right = vector(view.up).cross(eye).normalize();
    const axes = [right, eye.clone().cross(right), eye];
    const [lows, highs] = extents(axes);
    const target = new THREE.Vector3();
    axes.forEach((axis, k) => target.addScaledVector(axis, (lows[k] + highs[k]) / 2));
    const [width, height] = [highs[0] - lows[0], highs[1] - lows[1]];
    const { clientWidth, clientHeight } = canvas.parentElement;
    const shorter = Math.min(clientWidth, clientHeight);
    lookAt(target, eye, axes[1], 0.54 * shorter * Math.max(width / clientWidth, height / clientHeight));
  }

  // How far the main surface, and all that is shown besides, reach along some directions.
  function extents(axes) {
    const kept = scene.frames ? null : main(); // Of frames, each has its own surface.
    const shown = [...layers.values(), chosen].filter((each) => each && (each.visible || each === kept));
    const lows = axes.map(() => Infinity);
    const highs = axes.map(() => -Infinity);
    for (const { array } of shown.map((each) => each.geometry.attributes.position)) {
      for (let v = 0; v < array.length; v += 3) {
        axes.forEach((axis, k) => {
          const at = array[v] * axis.x + array[v + 1] * axis.y + array[v + 2] * axis.z;
          lows[k] = Math.min(lows[k], at);
          highs[k] = Math.max(highs[k], at);
        });
      }
    }
    return [lows, highs];
  }

  function goTo(place) {
    home = null;
    const eye = place.towards ? vector(place.towards) : new THREE.Vector3(0, 0, 1);
    const up = Math.abs(eye.clone().normalize().y) < 0.9 ? vector([0, 1, 0]) : vector([0, 0, 1]);
    lookAt(vector(place.position_mm), eye, up, 1.05 * place.radius_mm);
    mark(place.towards ? vector(place.position_mm) : null);
    root.scrollIntoView({ behavior: "instant", block: "start" });
  }

  // A ring around a place, over all that hides it.
  let marked = null;

  function mark(position) {
    marked = position;
    find(".ring").hidden = !position;
    change();
  }

  const main = () => layers.get(scene.layers[0].name);

  // --- what is written over the view -------------------------------------------------------------------------------

  const labels = scene.teeth.map((tooth) => {
    const label = document.createElement("span");
    label.textContent = tooth.name;
    find(".teeth").append(label);
    return [label, vector(tooth.position_mm)];
  });
  find(".teeth").hidden = true;

  function place(element, position) {
    const at = position.clone().project(camera);
    element.style.left = `${50 + 50 * at.x}%`;
    element.style.top = `${50 - 50 * at.y}%`;
  }

  function placeOverlays() {
    if (!find(".teeth").hidden) labels.forEach(([label, position]) => place(label, position));
    if (marked) place(find(".ring"), marked);
  }

  function showLength() {
    const pixelsPerMm = (canvas.clientWidth * camera.zoom) / (camera.right - camera.left);
    const steps = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];
    const length = steps.filter((each) => each * pixelsPerMm <= 0.28 * canvas.clientWidth).pop() ?? steps[0];
    find(".length span").style.width = `${length * pixelsPerMm}px`;
    find(".length b").textContent = `${length} ${lengthUnit}`;
  }

  function showTicks() {
    const sign = (value) => (value > 0 ? "+" : value < 0 ? "−" : "");
    for (const legend of root.querySelectorAll("[data-scale]")) {
      const { end, signed } = scales.get(legend.dataset.scale);
      legend.querySelectorAll(".ticks span").forEach((tick, k) => {
        const value = signed ? end * (k / 2 - 1) : (end * k) / 4;
        tick.textContent = value ? `${signed ? sign(value) : ""}${Number(Math.abs(value).toPrecision(3))}` : "0";
      });
    }
  }

  // What a click reads: the values that are coloured, or without colours those that were first.
  const readable = () => scale ?? scene.scales[0];

  function placeOf(event) {
    const box = canvas.getBoundingClientRect();
    return new THREE.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
  }

  function read(at) {
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, camera);
    const surfaces = [...layers.values()].filter((each) => each.isMesh && each.visible && each.userData.values[readable()?.name]);
    const [hit] = ray.intersectObjects(surfaces, false);
    const readout = find(".readout");
    readout.hidden = !hit;
    if (!hit) return;
    const { name, unit, signed, per_step: step } = readable();
    const value = hit.object.userData.values[name][hit.face.a];
    const amount = value * step;
    const where = hit.point.toArray().map((each) => each.toFixed(2)).join(", ");
    const text = value === UNKNOWN ? "not known" : `${signed && amount > 0 ? "+" : ""}${amount.toFixed(unit === "mm" ? 3 : 1)} ${unit}`;
    readout.textContent = `${text}  at ${where} ${lengthUnit}`.replace(/-/g, "−");
  }

  // --- keys ----------------------------------------------------------------------------------------------------------

  const TURN = Math.PI / 24;
  const STEP = 0.1;

  const axisOf = (column) => new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, column);

  // The surface follows the arrows, which means that the camera goes the other way.
  function turn([right, up]) {
    const about = axisOf(0).multiplyScalar(up).addScaledVector(axisOf(1), -right);
    const eye = camera.position.clone().sub(controls.target).applyAxisAngle(about, TURN);
    camera.up.copy(axisOf(1)).applyAxisAngle(about, TURN);
    camera.position.copy(controls.target).add(eye);
    camera.lookAt(controls.target);
  }

  function move([right, up]) {
    const size = (-STEP * 2 * half) / camera.zoom;
    const by = axisOf(0).multiplyScalar(size * right).addScaledVector(axisOf(1), size * up);
    camera.position.add(by);
    controls.target.add(by);
  }

  function zoom(factor) {
    camera.zoom *= factor;
    camera.updateProjectionMatrix();
  }

  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const zooms = { "+": 1.2, "=": 1.2, "-": 1 / 1.2 };

  function onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const [arrow, factor] = [arrows[event.key], zooms[event.key]];
    if (event.key === "0") find("[data-reset]").click();
    else if (event.key === "Enter") read(new THREE.Vector2());
    else if (arrow) (event.shiftKey ? move : turn)(arrow);
    else if (factor) zoom(factor);
    else return;
    if (arrow || factor) home = null;
    event.preventDefault();
    camera.updateMatrixWorld();
    change();
  }

  // --- buttons -------------------------------------------------------------------------------------------------------

  const press = (button, on) => button.setAttribute("aria-pressed", String(on));
  const toggled = (button) => {
    const on = button.getAttribute("aria-pressed") !== "true";
    press(button, on);
    change();
    return on;
  };

  const groupOf = (button) => scene.layers.find((each) => each.name === button.dataset.layer).group;

  // Of the layers of a group one is seen.
  function show(button) {
    const group = groupOf(button);
    layers.get(button.dataset.layer).visible = toggled(button) || Boolean(group);
    if (!group) return;
    for (const other of root.querySelectorAll("[data-layer]")) {
      if (groupOf(other) !== group) continue;
      press(other, other === button);
      layers.get(other.dataset.layer).visible = other === button;
    }
  }

  const repaint = () => layers.forEach((each) => each.isMesh && paint(each));

  // Of the scales one is shown, or none; the legend is that of the last one.
  function color(button) {
    scale = toggled(button) ? scales.get(button.dataset.colors) : null;
    for (const other of root.querySelectorAll("[data-colors]")) if (other !== button) press(other, false);
    for (const legend of root.querySelectorAll("[data-scale]")) legend.hidden = legend.dataset.scale !== button.dataset.colors;
    find(".readout").hidden = true;
    repaint();
  }

  function bind() {
    for (const button of root.querySelectorAll("[data-layer]")) {
      button.addEventListener("click", () => {
        show(button);
        if (home) whole(home);
      });
    }
    for (const button of root.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => {
        mark(null);
        whole(button.dataset.view);
      });
    }
    find("[data-reset]").addEventListener("click", () => {
      if (chosen) world.remove(chosen);
      chosen = null;
      mark(null);
      whole();
    });
    for (const button of root.querySelectorAll("[data-colors]")) button.addEventListener("click", () => color(button));
    for (const choice of root.querySelectorAll("[data-range]")) {
      choice.addEventListener("change", () => {
        scales.get(choice.closest("[data-scale]").dataset.scale).end = Number(choice.value);
        repaint();
        showTicks();
        change();
      });
    }
    if (labels.length) {
      find("[data-teeth]").hidden = false;
      find("[data-teeth]").addEventListener("click", (event) => {
        find(".teeth").hidden = !toggled(event.currentTarget);
      });
    }
    for (const button of document.querySelectorAll("[data-place]")) {
      button.addEventListener("click", () => goTo(scene.teeth[Number(button.dataset.place)]));
    }
    for (const button of document.querySelectorAll("[data-worst]")) {
      button.addEventListener("click", () => goTo(scene.worst[Number(button.dataset.worst)]));
    }
    for (const button of document.querySelectorAll("[data-frame]")) {
      button.addEventListener("click", () => showFrame(button.dataset.frame));
    }
    let down = null;
    canvas.addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) read(placeOf(event));
    });
    canvas.addEventListener("keydown", onKey);
    addEventListener("beforeprint", snapshot);
  }

  // The cameras of one frame, in another colour.
  function showFrame(name) {
    const layer = scene.layers.find((each) => each.name === "cameras");
    const index = layer?.frames.indexOf(name) ?? -1;
    if (chosen) world.remove(chosen);
    if (index < 0) return;
    const all = layers.get("cameras").geometry.attributes.position;
    const count = 3 * layer.points_per_frame;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(all.array.slice(index * count, (index + 1) * count), 3));
    chosen = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: ACCENT }));
    world.add(chosen);
    mark(null);
    whole("Front");
    root.scrollIntoView({ behavior: "instant", block: "start" });
  }

  // --- modes of a shape model ----------------------------------------------------------------------------------------

  async function bindModes() {
    if (!scene.modes) return;
    const surface = main();
    const { geometry } = surface;
    const rest = geometry.attributes.position.array.slice();
    const normals = geometry.attributes.normal.array.slice();
    const fields = await Promise.all(scene.modes.map((mode) => unpack(mode.field)));
    const inputs = [...root.querySelectorAll("[data-mode]")];
    const [{ name, per_step: step }] = scene.scales;
    const shifts = new Int16Array(rest.length / 3);
    surface.userData.values[name] = shifts;
    const move = () => {
      const { array } = geometry.attributes.position;
      array.set(rest);
      inputs.forEach((input, k) => {
        const weight = Number(input.value);
        input.nextElementSibling.textContent = `${weight > 0 ? "+" : weight < 0 ? "−" : ""}${Math.abs(weight)} SD`;
        const scale = weight * scene.modes[k].step;
        if (scale) for (let i = 0; i < array.length; i++) array[i] += scale * fields[k][i];
      });
      for (let v = 0; v < array.length; v += 3) {
        let shift = 0;
        for (let i = v; i < v + 3; i++) shift += (array[i] - rest[i]) * normals[i];
        shifts[v / 3] = Math.max(-32767, Math.min(32767, Math.round(shift / step)));
      }
      geometry.attributes.position.needsUpdate = true;
      geometry.computeVertexNormals();
      paint(surface);
      change();
    };
    inputs.forEach((input) => input.addEventListener("input", move));
    find("[data-mean]").addEventListener("click", () => {
      inputs.forEach((input) => (input.value = 0));
      move();
    });
    move();
  }

  // --- one surface after the other ---------------------------------------------------------------------------------------

  // Each frame colours one of the surfaces, which alone is seen then.
  function bindFrames() {
    if (!scene.frames) return;
    const [slider, list] = [find("[data-frame-at]"), find("[data-frame-named]")];
    const [{ name }] = scene.scales;
    const go = async (at) => {
      [slider.value, list.value] = [at, at];
      const frame = scene.frames[at];
      frame.unpacked ??= await unpack(frame.values);
      if (Number(slider.value) !== at) return; // Another one was asked for meanwhile.
      layers.forEach((layer, key) => (layer.visible = key === frame.layer));
      const surface = layers.get(frame.layer);
      surface.userData.values[name] = frame.unpacked;
      paint(surface);
      find(".readout").hidden = true;
      if (home) whole(home);
      change();
    };
    slider.addEventListener("input", () => go(Number(slider.value)));
    list.addEventListener("change", () => go(Number(list.value)));
  }

  // --- start ---------------------------------------------------------------------------------------------------------

  for (const layer of scene.layers) {
    const object = await (layer.kind === "mesh" ? addMesh(layer) : addLines(layer));
    object.visible = layer.visible;
    layers.set(layer.name, object);
    world.add(object);
    if (object.isMesh) paint(object);
  }
  await bindModes();
  bindFrames();
  bind();
  showTicks();
  whole();
  controls.addEventListener("change", change);
  controls.addEventListener("start", () => (home = null));
  new ResizeObserver(([{ contentRect }]) => (home && contentRect.width ? whole(home) : resize())).observe(canvas.parentElement);
  root.classList.add("live");
  const loop = () => {
    controls.update();
    draw();
    requestAnimationFrame(loop);
  };
  loop();
  snapshot();
  root.dataset.ready = "";
})();
