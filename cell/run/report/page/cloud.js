// The 3-D view: points in an orthographic projection with a depth buffer, on a plain canvas, so that it prints.
"use strict";
(function () {
  const canvas = document.getElementById("cloud");
  const data = JSON.parse(document.getElementById("cloud-data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const points = new Int16Array(bytes(data.points).buffer);
  const shades = bytes(data.shades);
  const palette = bytes(data.palette);
  const pen = canvas.getContext("2d");
  const START = { turn: -0.6, tilt: 0.95, zoom: 1 };
  let view = { ...START };
  let waiting = false;
  const GROUND = 205; // grey, because the middle of the scale is white
  let fit = 1; // px for a mm at zoom 1

  function axes() {
    const [ct, st, cp, sp] = [Math.cos(view.turn), Math.sin(view.turn), Math.cos(view.tilt), Math.sin(view.tilt)];
    // Rows: right, up, towards the eye. At tilt 0 the eye looks down on x and y.
    return [[ct, -st, 0], [st * cp, ct * cp, sp], [-st * sp, -ct * sp, cp]];
  }

  function along(axis, i) {
    return data.step * (axis[0] * points[3 * i] + axis[1] * points[3 * i + 1] + axis[2] * points[3 * i + 2]);
  }

  function fitted() {
    const [right, up] = axes();
    let wide = 0.5, high = 0.5;
    for (let i = 0; i < data.count; i++) {
      wide = Math.max(wide, Math.abs(along(right, i)));
      high = Math.max(high, Math.abs(along(up, i)));
    }
    fit = Math.min(0.45 * canvas.width / wide, 0.42 * canvas.height / high);
  }

  function draw() {
    waiting = false;
    const width = canvas.width, height = canvas.height;
    const [right, up, eye] = axes();
    const scale = fit * view.zoom;
    const picture = pen.createImageData(width, height);
    const pixels = picture.data.fill(GROUND);
    const depth = new Float32Array(width * height).fill(-Infinity);
    for (let at = 3; at < pixels.length; at += 4) pixels[at] = 255;
    const size = Math.max(1, Math.round(1.3 * scale * data.apart));
    for (let i = 0; i < data.count; i++) {
      const u = Math.round(width / 2 + scale * along(right, i) - size / 2);
      const v = Math.round(height / 2 - scale * along(up, i) - size / 2);
      const near = along(eye, i);
      const shade = 3 * shades[i];
      for (let row = Math.max(0, v); row < Math.min(height, v + size); row++) {
        for (let column = Math.max(0, u); column < Math.min(width, u + size); column++) {
          const at = row * width + column;
          if (near <= depth[at]) continue;
          depth[at] = near;
          pixels[4 * at] = palette[shade];
          pixels[4 * at + 1] = palette[shade + 1];
          pixels[4 * at + 2] = palette[shade + 2];
        }
      }
    }
    pen.putImageData(picture, 0, 0);
    furniture(right, up, scale);
  }

  function furniture(right, up, scale) {
    const unit = canvas.width / 900;
    pen.font = `${Math.round(14 * unit)}px sans-serif`;
    pen.lineWidth = 2 * unit;
    pen.textBaseline = "middle";
    const corner = [60 * unit, canvas.height - 60 * unit];
    [["x", "#c00000"], ["y", "#008000"], ["z", "#0000c0"]].forEach(([name, colour], k) => {
      const end = [corner[0] + 38 * unit * right[k], corner[1] - 38 * unit * up[k]];
      pen.strokeStyle = pen.fillStyle = colour;
      pen.beginPath();
      pen.moveTo(...corner);
      pen.lineTo(...end);
      pen.stroke();
      pen.fillText(name, corner[0] + 50 * unit * right[k] - 4 * unit, corner[1] - 50 * unit * up[k]);
    });
    const length = [1, 2, 5, 10, 20, 50, 100, 200, 500].filter((mm) => mm * scale < 0.3 * canvas.width).pop() || 1;
    const from = canvas.width - 20 * unit - length * scale, level = canvas.height - 24 * unit;
    pen.strokeStyle = pen.fillStyle = "#000000";
    pen.beginPath();
    pen.moveTo(from, level);
    pen.lineTo(from + length * scale, level);
    pen.stroke();
    pen.fillText(`${length} mm`, from, level - 14 * unit);
  }

  function show(change) {
    view = { ...view, ...change };
    view.tilt = Math.max(-Math.PI, Math.min(Math.PI, view.tilt));
    view.zoom = Math.max(0.3, Math.min(40, view.zoom));
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(draw);
    }
  }

  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    show({ turn: view.turn + 0.008 * (event.clientX - held[0]), tilt: view.tilt - 0.008 * (event.clientY - held[1]) });
    held = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    show({ zoom: view.zoom * Math.exp(-0.0015 * event.deltaY) });
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = {
      ArrowLeft: { turn: view.turn - 0.1 }, ArrowRight: { turn: view.turn + 0.1 },
      ArrowUp: { tilt: view.tilt - 0.1 }, ArrowDown: { tilt: view.tilt + 0.1 },
      "+": { zoom: 1.2 * view.zoom }, "-": { zoom: view.zoom / 1.2 },
    };
    if (!(event.key in keys)) return;
    event.preventDefault();
    show(keys[event.key]);
  });
  const views = { above: { turn: 0, tilt: 0, zoom: 1 }, side: { turn: 0, tilt: Math.PI / 2, zoom: 1 }, start: START };
  for (const [name, to] of Object.entries(views)) {
    document.getElementById(`view-${name}`).addEventListener("click", () => {
      view = { ...view, ...to };
      fitted();
      show({});
    });
  }
  fitted();
  draw();
})();
