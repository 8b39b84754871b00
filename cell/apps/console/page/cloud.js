// The cloud that grows during a sweep, coloured by its distance from the nominal surface; and the legend of its colours.

import * as THREE from './vendor/three.module.min.js';

const MOST = 400000;
const SCALE = [[0.13, 0.28, 0.75], [0.35, 0.7, 0.95], [0.92, 0.92, 0.88], [0.98, 0.65, 0.3], [0.75, 0.08, 0.12]];
const UNKNOWN = [0.45, 0.45, 0.5];

// Red, green, blue of a deviation in mm on a scale of ±limit mm; more than that has the colour of the end.
export function colour(deviation, limit) {
  if (!Number.isFinite(deviation)) return UNKNOWN;
  const at = (Math.max(-1, Math.min(1, deviation / limit)) + 1) / 2 * (SCALE.length - 1);
  const k = Math.min(SCALE.length - 2, Math.floor(at));
  return SCALE[k].map((low, axis) => low + (SCALE[k + 1][axis] - low) * (at - k));
}

export class Cloud {
  constructor(wake) {
    this.wake = wake;
    this.limit = 0.2;
    this.count = 0;
    this.room = 0;
    this.geometry = new THREE.BufferGeometry();
    this.points = new THREE.Points(this.geometry, new THREE.PointsMaterial({ size: 2.5, sizeAttenuation: false, vertexColors: true }));
    this.points.frustumCulled = false;
    this.reserve(4096);
  }

  reserve(count) {
    if (count <= this.room) return;
    this.room = Math.min(MOST, Math.max(count, 2 * this.room));
    const keep = (old, size) => {
      const grown = new Float32Array(size);
      if (old) grown.set(old.subarray(0, Math.min(old.length, size)));
      return grown;
    };
    this.deviations = keep(this.deviations, this.room);
    this.position = new THREE.BufferAttribute(keep(this.position?.array, 3 * this.room), 3);
    this.color = new THREE.BufferAttribute(keep(this.color?.array, 3 * this.room), 3);
    this.geometry.dispose();
    this.geometry.setAttribute('position', this.position);
    this.geometry.setAttribute('color', this.color);
  }

  clear() {
    this.count = 0;
    this.geometry.setDrawRange(0, 0);
    this.wake();
  }

  // More points: (n × 4) x, y, z in m in the base and the deviation in mm, NaN where there is none.
  add(values) {
    const more = Math.min(values.length / 4, MOST - this.count);
    this.reserve(this.count + more);
    for (let k = 0; k < more; k += 1) {
      const at = this.count + k;
      this.position.setXYZ(at, values[4 * k], values[4 * k + 1], values[4 * k + 2]);
      this.deviations[at] = values[4 * k + 3];
      this.color.setXYZ(at, ...colour(this.deviations[at], this.limit));
    }
    this.count += more;
    this.geometry.setDrawRange(0, this.count);
    this.position.needsUpdate = this.color.needsUpdate = true;
    this.wake();
  }

  // Another end of the scale, mm.
  scale(limit) {
    this.limit = limit;
    for (let at = 0; at < this.count; at += 1) this.color.setXYZ(at, ...colour(this.deviations[at], limit));
    this.color.needsUpdate = true;
    this.wake();
  }
}

// Draw the scale into a canvas.
export function legend(canvas) {
  const pen = canvas.getContext('2d');
  for (let x = 0; x < canvas.width; x += 1) {
    const [r, g, b] = colour(2 * x / (canvas.width - 1) - 1, 1).map((v) => Math.round(255 * v));
    pen.fillStyle = `rgb(${r},${g},${b})`;
    pen.fillRect(x, 0, 1, canvas.height);
  }
}
