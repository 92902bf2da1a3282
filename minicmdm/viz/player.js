// Plays skeletons on canvases: drag to orbit, wheel to zoom, scrub, play, change speed. No library, no network.
//
// minicmdmPlayer(root, data) fills the element `root` and returns {seek, play, pause, destroy}. `data` is
//   {fps, parents: [J], sides: [J] ("left" | "right" | "middle"), feet: [2], head,
//    clips: [{caption, frames, scale, joints, contacts, noise}]}
// joints: base64 of int16 (frames, J, 3); times scale: metres. contacts: two digits a frame, left and right foot (0 in
// the air, 1 planted, 2 sliding). noise: base64 of a byte a frame (255 is pure noise), or null.
// A page calls it from a script tag; a notebook widget appends `export default {render}` and calls it there.
// root.dataset.frame holds the frame on show, for tests.

function minicmdmPlayer(root, data) {
  "use strict";
  const COLOURS = { left: [224, 122, 31], right: [37, 99, 201], middle: [69, 75, 87] };
  const [NOISE, CLEAN] = [[176, 112, 126], [214, 218, 226]]; // what noise turns limbs into; the scrub bar without any
  const CONTACTS = { 1: ["rgba(20, 140, 80, 0.55)", "rgb(20, 120, 70)"], 2: ["transparent", "rgb(205, 20, 40)"] };
  const HOME = { yaw: 0.6, pitch: 0.22, distance: 3.9 };
  const SPEEDS = [0.25, 0.5, 1, 2];
  const clips = data.clips.map((clip) => ({
    ...clip, joints: decode(clip.joints, clip.scale), noise: clip.noise && bytesOf(clip.noise),
  }));
  const stride = 3 * data.parents.length; // a frame
  const frames = Math.max(...clips.map((clip) => clip.frames));
  const view = { ...HOME };
  let now = 0; // in frames; between two of them while playing
  let speed = 1;
  let playing = false;
  let trail = true;
  let contacts = true;
  let lastTick = 0;
  let request = 0;

  function bytesOf(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  }

  function decode(text, scale) {
    const bytes = bytesOf(text);
    const numbers = new DataView(bytes.buffer);
    const values = new Float32Array(bytes.length / 2);
    for (let i = 0; i < values.length; i++) values[i] = numbers.getInt16(2 * i, true) * scale;
    return values;
  }

  function mix(from, to, share) {
    return `rgb(${from.map((value, i) => Math.round(value + (to[i] - value) * share)).join(", ")})`;
  }

  // ---- the page: one canvas per clip, one row of controls ---------------------------------------------
  function make(tag, parent, style, attributes) {
    const element = document.createElement(tag);
    Object.assign(element.style, style || {});
    for (const [name, value] of Object.entries(attributes || {})) element.setAttribute(name, value);
    parent.appendChild(element);
    return element;
  }

  root.replaceChildren();
  root.tabIndex = 0;
  root.setAttribute("aria-label", "Motion player: space plays, arrow keys step, drag orbits, wheel zooms");
  Object.assign(root.style, {
    font: "14px system-ui, sans-serif", color: "#1f2430", outlineOffset: "2px", colorScheme: "light",
  });
  const stage = make("div", root, {
    display: "grid", gap: "10px",
    gridTemplateColumns: `repeat(${Math.min(clips.length, 4)}, minmax(0, 1fr))`,
  });
  for (const clip of clips) {
    const figure = make("figure", stage, { margin: "0", display: "flex", flexDirection: "column" });
    const caption = make("figcaption", figure, { padding: "4px 2px", minHeight: "1.3em", flex: "1" });
    caption.textContent = clip.caption; // as text, so a caption can never become markup
    clip.canvas = make("canvas", figure, {
      width: "100%", aspectRatio: clips.length > 1 ? "1 / 1" : "16 / 10", maxHeight: "calc(100vh - 120px)",
      borderRadius: "8px", background: "#f5f6f8", cursor: "grab", touchAction: "none", display: "block",
    }, { role: "img", "aria-label": `Skeleton: ${clip.caption}` });
  }
  const bar = make("div", root, {
    display: "flex", gap: "10px", alignItems: "center", padding: "8px 0", flexWrap: "wrap",
  });
  const playButton = make("button", bar, { width: "5.5em", padding: "4px 0" }, { type: "button" });
  const scrub = make("div", bar, { flex: "1 1 160px", minWidth: "0" });
  const slider = make("input", scrub, { width: "100%", margin: "0", display: "block" }, {
    type: "range", min: 0, max: frames - 1, step: 1, value: 0, "aria-label": "Frame",
  });
  for (const clip of clips) {
    if (!clip.noise) continue;
    const strip = make("canvas", make("div", scrub, { margin: "2px 8px 0" }), { // a thumb is 16 pixels wide
      width: `${(100 * clip.frames) / frames}%`, height: "7px", display: "block", imageRendering: "pixelated",
    }, { width: clip.frames, height: 1, role: "img", "aria-label": `Noise: ${clip.caption}`, title: "noise" });
    clip.noise.forEach((noise, frame) => {
      const context = strip.getContext("2d");
      context.fillStyle = mix(CLEAN, NOISE, noise / 255);
      context.fillRect(frame, 0, 1, 1);
    });
  }
  const clock = make("output", bar, { minWidth: "11em", fontVariantNumeric: "tabular-nums" });
  const speedMenu = make("select", bar, {}, { "aria-label": "Speed" });
  for (const value of SPEEDS) make("option", speedMenu, {}, { value }).textContent = `${value}×`;
  speedMenu.value = speed;
  function box(name, title, onchange) {
    const label = make("label", bar, { whiteSpace: "nowrap" }, { title });
    const input = make("input", label, {}, { type: "checkbox" });
    input.checked = true;
    input.onchange = () => { onchange(input.checked); draw(); };
    label.append(` ${name}`);
    return input;
  }
  const trailBox = box("trail", "where the pelvis has been and will be", (on) => (trail = on));
  const contactBox = box("contacts", "disc: the foot is planted; ring: it slides", (on) => (contacts = on));
  const homeButton = make("button", bar, { padding: "4px 8px" }, { type: "button" });
  homeButton.textContent = "reset view";
  const legend = make("span", bar, { whiteSpace: "nowrap" });
  for (const side of ["left", "right"]) {
    make("b", legend, { color: mix(COLOURS[side], NOISE, 0), marginRight: "8px" }).textContent = side;
  }
  if (clips.some((clip) => clip.noise)) make("b", legend, { color: mix(NOISE, CLEAN, 0) }).textContent = "noise";

  // ---- the camera: turns about a point above the root's place on the floor ----------------------------
  function camera(clip, pose) {
    const { width, height } = clip.canvas;
    const focal = Math.min(width, height) * 1.35;
    const [cosYaw, sinYaw] = [Math.cos(view.yaw), Math.sin(view.yaw)];
    const [cosPitch, sinPitch] = [Math.cos(view.pitch), Math.sin(view.pitch)];
    return (x, y, z) => {
      const [dx, dy, dz] = [x - pose[0], y - 0.85, z - pose[2]];
      const right = cosYaw * dx - sinYaw * dz;
      const near = sinYaw * dx + cosYaw * dz;
      const away = view.distance - sinPitch * dy - cosPitch * near; // distance along the line of sight
      const size = focal / Math.max(away, 0.05);
      const up = cosPitch * dy - sinPitch * near;
      return { x: width / 2 + right * size, y: height / 2 - up * size, away, size };
    };
  }

  function lines(context, pairs, colour, width) { // in one stroke, so that where they cross is no darker
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    for (const [a, b] of pairs) {
      if (a.away < 0.2 || b.away < 0.2) continue; // behind the lens
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y);
    }
    context.stroke();
  }

  function poseAt(clip, time) {
    const last = clip.frames - 1;
    const first = Math.min(Math.floor(time), last);
    const second = Math.min(first + 1, last);
    const part = Math.min(time, last) - first;
    const pose = new Float32Array(stride);
    for (let i = 0; i < stride; i++) {
      pose[i] = clip.joints[stride * first + i] * (1 - part) + clip.joints[stride * second + i] * part;
    }
    return pose;
  }

  // ---- drawing ----------------------------------------------------------------------------------------
  function drawFloor(context, project, pose, pixel) {
    const [cell, reach] = [0.5, 7]; // half a metre; 7 cells each way, fading out
    const [x0, z0] = [Math.round(pose[0] / cell), Math.round(pose[2] / cell)];
    for (let i = -reach; i <= reach; i++) {
      for (let k = -reach; k < reach; k++) {
        for (const alongX of [true, false]) {
          const [ax, az] = alongX ? [x0 + k, z0 + i] : [x0 + i, z0 + k];
          const [bx, bz] = alongX ? [ax + 1, az] : [ax, az + 1];
          const [midX, midZ] = [((ax + bx) * cell) / 2, ((az + bz) * cell) / 2];
          const fade = 1 - Math.hypot(midX - pose[0], midZ - pose[2]) / (reach * cell);
          if (fade <= 0) continue;
          const strong = (alongX ? az : ax) % 2 === 0; // every metre
          const colour = `rgba(120, 128, 145, ${(strong ? 0.6 : 0.25) * Math.sqrt(fade)})`;
          lines(context, [[project(ax * cell, 0, az * cell), project(bx * cell, 0, bz * cell)]], colour, pixel);
        }
      }
    }
  }

  function drawContacts(context, project, pose, touching, pixel) {
    data.feet.forEach((foot, i) => {
      if (!CONTACTS[touching[i]]) return;
      [context.fillStyle, context.strokeStyle] = CONTACTS[touching[i]];
      context.lineWidth = 2.5 * pixel;
      context.beginPath();
      for (let turn = 0; turn < 6.28; turn += 0.2) {
        const p = project(pose[3 * foot] + 0.12 * Math.cos(turn), 0, pose[3 * foot + 2] + 0.12 * Math.sin(turn));
        if (p.away < 0.2) return;
        context.lineTo(p.x, p.y);
      }
      context.closePath();
      context.fill();
      context.stroke();
    });
  }

  function drawClip(clip) {
    const context = clip.canvas.getContext("2d");
    const pixel = window.devicePixelRatio || 1;
    const pose = poseAt(clip, now);
    const frame = Math.min(Math.floor(now), clip.frames - 1);
    const noise = clip.noise ? clip.noise[frame] / 255 : 0;
    const colour = (side) => mix(COLOURS[side], NOISE, 0.85 * noise); // a hint of left and right remains
    const project = camera(clip, pose);
    const at = (j) => project(pose[3 * j], pose[3 * j + 1], pose[3 * j + 2]);
    const shadow = (j) => project(pose[3 * j], 0, pose[3 * j + 2]);
    context.clearRect(0, 0, clip.canvas.width, clip.canvas.height);
    context.lineCap = "round";
    drawFloor(context, project, pose, pixel);

    if (trail) { // where the root has been and will go, on the floor
      const place = (t) => project(clip.joints[stride * t], 0, clip.joints[stride * t + 2]);
      const [past, future] = [[], []];
      for (let t = 1; t < clip.frames; t++) (t <= now ? past : future).push([place(t - 1), place(t)]);
      lines(context, future, "rgba(180, 40, 90, 0.25)", 2 * pixel);
      lines(context, past, "rgba(180, 40, 90, 0.8)", 2 * pixel);
    }
    if (contacts) drawContacts(context, project, pose, clip.contacts.slice(2 * frame, 2 * frame + 2), pixel);
    const bones = [];
    for (let j = 1; j < data.parents.length; j++) bones.push([data.parents[j], j]);
    // A shadow straight below shows at once what floats or sinks.
    const below = bones.map(([p, j]) => [shadow(p), shadow(j)]);
    lines(context, below, "rgba(30, 35, 50, 0.15)", 0.05 * shadow(0).size);
    bones.sort((a, b) => at(b[0]).away + at(b[1]).away - at(a[0]).away - at(a[1]).away); // far ones first
    for (const [p, j] of bones) lines(context, [[at(p), at(j)]], colour(data.sides[j]), 0.038 * at(j).size);
    const head = at(data.head);
    if (head.away > 0.2) {
      context.fillStyle = colour("middle");
      context.beginPath();
      context.arc(head.x, head.y, 0.085 * head.size, 0, 7);
      context.fill();
    }
  }

  function draw() {
    for (const clip of clips) {
      const pixel = window.devicePixelRatio || 1;
      const width = Math.round(clip.canvas.clientWidth * pixel);
      const height = Math.round(clip.canvas.clientHeight * pixel);
      if (clip.canvas.width !== width || clip.canvas.height !== height) {
        clip.canvas.width = width;
        clip.canvas.height = height;
      }
      if (width > 0 && height > 0) drawClip(clip);
    }
    const frame = Math.floor(now);
    root.dataset.frame = frame;
    slider.value = frame;
    clock.textContent = `frame ${frame} of ${frames - 1}, ${(now / data.fps).toFixed(2)} s`;
    playButton.textContent = playing ? "pause" : "play";
  }

  function tick(time) {
    if (!playing) return;
    if (!root.isConnected && lastTick) return pause(); // the notebook cell was closed
    if (lastTick) now += ((time - lastTick) / 1000) * data.fps * speed;
    lastTick = time;
    if (now > frames - 1) now = 0;
    draw();
    request = requestAnimationFrame(tick);
  }

  function play() {
    if (playing || frames < 2) return;
    playing = true;
    lastTick = 0;
    request = requestAnimationFrame(tick);
    draw();
  }

  function pause() {
    playing = false;
    cancelAnimationFrame(request);
    now = Math.floor(now);
    draw();
  }

  function seek(frame) {
    pause();
    now = Math.min(Math.max(Math.round(frame), 0), frames - 1);
    draw();
  }

  // ---- hands on it ------------------------------------------------------------------------------------
  playButton.onclick = () => (playing ? pause() : play());
  slider.oninput = () => seek(Number(slider.value));
  speedMenu.onchange = () => (speed = Number(speedMenu.value));
  homeButton.onclick = () => { Object.assign(view, HOME); draw(); };
  for (const { canvas } of clips) {
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      root.focus({ preventScroll: true });
    };
    canvas.onpointermove = (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      view.yaw -= event.movementX * 0.01;
      view.pitch = Math.min(Math.max(view.pitch + event.movementY * 0.01, -0.1), 1.55);
      draw();
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.distance = Math.min(Math.max(view.distance * Math.exp(event.deltaY * 0.001), 1.5), 20);
      draw();
    }, { passive: false });
  }
  const keys = {
    " ": () => (playing ? pause() : play()),
    ArrowRight: () => seek(Math.floor(now) + 1),
    ArrowLeft: () => seek(Math.floor(now) - 1),
    Home: () => seek(0),
    End: () => seek(frames - 1),
    r: () => homeButton.onclick(),
    t: () => trailBox.click(),
    c: () => contactBox.click(),
  };
  function onKey(event) {
    event.stopPropagation(); // or JupyterLab takes the key for itself
    const pressesIt = event.key === " " && event.target !== root && event.target !== slider; // a button, a box
    if (pressesIt || event.target === speedMenu) return;
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  }
  root.addEventListener("keydown", onKey);
  const resized = new ResizeObserver(draw);
  resized.observe(root);
  draw();

  function destroy() {
    pause();
    resized.disconnect();
    root.removeEventListener("keydown", onKey);
    root.replaceChildren();
  }
  return { seek, play, pause, destroy };
}
