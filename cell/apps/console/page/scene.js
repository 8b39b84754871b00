// The cell in 3-D: bodies as the planner has them, turned and shifted by what the devices read. Frames: docs/reference/console.md.

import * as THREE from './vendor/three.module.min.js';
import { OrbitControls } from './vendor/OrbitControls.js';
import { Cloud } from './cloud.js';

const LOOKS = [
  [/^part|placed/, 0xe0a030, 1],
  [/^claw/, 0xc8763a, 1],
  [/head|camera/, 0x39424e, 1],
  [/board|plate/, 0xf4f4f0, 1],
  [/post/, 0x8a8f98, 1],
  [/deck/, 0x55606e, 1],
  [/table/, 0x9c8f7c, 1],
  [/obstacle/, 0xb04a4a, 0.55],
  [/joint|elbow|wrist|^base|shoulder/, 0x6f93b8, 1],
  [/./, 0xb9c7d6, 1],
];
const BASE = 0, FLANGE = 7;
const LINKS = ['base', 'shoulder', 'upper_arm', 'forearm', 'wrist_1', 'wrist_2', 'wrist_3'];
const FRAME_MS = 50;

// A pose of 16 numbers, row after row, as three.js has it.
const matrix = (numbers) => new THREE.Matrix4().set(...numbers);

function place(object, numbers) {
  object.matrixAutoUpdate = false;
  object.matrix.copy(numbers instanceof THREE.Matrix4 ? numbers : matrix(numbers));
  object.matrixWorldNeedsUpdate = true;
  return object;
}

function dots() {
  const picture = document.createElement('canvas');
  picture.width = picture.height = 128;
  const pen = picture.getContext('2d');
  pen.fillStyle = '#f4f4f0';
  pen.fillRect(0, 0, 128, 128);
  pen.fillStyle = '#222';
  for (let k = 0; k < 49; k += 1) {
    pen.beginPath();
    pen.arc(16 + 16 * (k % 7), 16 + 16 * Math.floor(k / 7), 4.5, 0, 7);
    pen.fill();
  }
  return new THREE.CanvasTexture(picture);
}

function mesh(body, dotted) {
  const [, color, opacity] = LOOKS.find(([pattern]) => pattern.test(body.name));
  const material = new THREE.MeshLambertMaterial({ color, opacity, transparent: opacity < 1 });
  let geometry;
  if (body.radius === null) {
    geometry = new THREE.BoxGeometry(...body.size);
  } else {
    geometry = new THREE.CapsuleGeometry(body.radius, body.size[2], 6, 18).rotateX(Math.PI / 2);
  }
  const board = /^board$|plate|large board/.test(body.name);
  const made = new THREE.Mesh(geometry, board ? Array(6).fill(material) : material);
  if (board) made.material.splice(4, 2, dotted, dotted);
  made.name = body.name;
  return place(made, body.placement);
}

function triangulated({ vertices, triangles }) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(vertices, 3));
  geometry.setIndex(triangles);
  geometry.computeVertexNormals();
  return geometry;
}

// A link as its mesh shows it, in the frame of what it is on.
function picture(mesh) {
  const material = new THREE.MeshLambertMaterial({ color: mesh.on === 'vehicle' ? 0x55606e : 0xb9c7d6, side: THREE.DoubleSide });
  const made = new THREE.Mesh(triangulated(mesh), material);
  made.name = `mesh ${mesh.on}`;
  return made;
}

export class CellScene {
  // `stage` is the element that holds the canvas. Throws where the browser draws no 3-D.
  constructor(stage) {
    this.stage = stage;
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 1.5));
    const canvas = this.renderer.domElement;
    canvas.setAttribute('role', 'img');
    canvas.setAttribute('aria-label', 'The cell in 3-D. Drag to turn, wheel or pinch to come closer.');
    stage.prepend(canvas);
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.02, 40);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener('change', () => this.wake());
    // Who turns it looks where they want; until then the view goes with the vehicle.
    this.controls.addEventListener('start', () => { this.looked = null; });
    this.world = new THREE.Scene();
    const sun = new THREE.DirectionalLight(0xffffff, 1.7);
    sun.position.set(-1.5, -2, 4);
    this.world.add(new THREE.HemisphereLight(0xffffff, 0x777788, 1.6), sun);
    this.cloud = new Cloud(() => this.wake());
    this.base = null;
    this.drawn = 0;
    new ResizeObserver(() => this.fit()).observe(stage);
    this.build(null);
    this.fit();
    this.view('cell');
  }

  // Draw another cell; `scene` is what the server told of its bodies, or null.
  build(scene) {
    if (this.root) {
      this.root.remove(this.cloud.points);
      this.cloud.points.removeFromParent();
      this.root.traverse((object) => {
        object.geometry?.dispose();
        [object.material].flat().forEach((material) => material?.dispose());
      });
      this.world.remove(this.root);
    }
    this.scene = scene;
    this.root = new THREE.Group();
    this.base = new THREE.Group();
    this.root.add(this.base);
    this.world.add(this.root);
    this.base.add(this.cloud.points);
    this.joints = [];
    if (scene !== null) this.furnish(scene);
    this.wake();
  }

  furnish(scene) {
    const dotted = new THREE.MeshLambertMaterial({ map: dots() });
    const frames = { [BASE]: this.base };
    let parent = this.base;
    scene.arm.parent_from_joint.forEach((pose, k) => {
      const stand = place(new THREE.Group(), pose);
      const turning = new THREE.Group();
      parent.add(stand.add(turning));
      this.joints.push(turning);
      parent = frames[k + 1] = turning;
    });
    const flange = place(new THREE.Group(), scene.arm.joint6_from_flange);
    parent.add(flange);
    frames[FLANGE] = flange;
    this.part = null;
    for (const body of scene.bodies) {
      const made = mesh(body, dotted);
      if (body.name === 'scan head') {
        // What the planner keeps free for the head on its whole way.
        made.material = new THREE.MeshLambertMaterial({ color: 0x39424e, transparent: true, opacity: 0.18 });
      }
      if (body.name === 'part') this.part = made;
      frames[body.parent].add(made);
    }
    this.partInClaw = this.part?.matrix.clone();
    const wheels = place(new THREE.Group(), matrix(scene.vehicle_from_base).invert());
    this.base.add(wheels);
    const pictures = new Map(scene.meshes.map((one) => [one.on, picture(one)]));
    pictures.forEach((made, on) => (on === 'vehicle' ? wheels : frames[on === 'flange' ? FLANGE : LINKS.indexOf(on)]).add(made));
    if (!pictures.has('vehicle')) wheels.add(...vehicle());
    this.flange = flange;
    this.carriage = new THREE.Group();
    this.railWay = new THREE.Vector3(...scene.rail.direction);
    this.carriage.add(mesh(scene.rail.head, dotted));
    flange.add(this.carriage);
    const eye = place(new THREE.Group(), scene.cameras.scan.flange_from_camera);
    this.carriage.add(eye);
    this.sheet = this.fan(scene.sheet.corners);
    eye.add(this.sheet);
    const target = place(new THREE.Group(), scene.cameras.target.flange_from_camera);
    target.add(sight(scene.cameras.target.sight));
    flange.add(target);
    const material = new THREE.LineBasicMaterial({ color: 0x1f9d55 });
    this.way = new THREE.Line(new THREE.BufferGeometry(), material);
    this.way.frustumCulled = false;
    this.base.add(this.way);
    if (scene.station) this.furnishStation(scene.station, dotted);
    this.pose({ joints: scene.arm.home, rail: 0, laser: false, place: scene.station?.base_from_place ?? null });
    this.view('cell');
  }

  furnishStation(station, dotted) {
    for (const body of station.bodies) if (body.name !== 'surface') this.root.add(mesh(body, dotted));
    const look = { color: 0x58a6a0, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 };
    const surface = new THREE.Mesh(triangulated(station.surface), new THREE.MeshLambertMaterial(look));
    this.root.add(place(surface, station.surface.place_from_surface));
  }

  fan(corners) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.Float32BufferAttribute(corners, 3));
    const look = { color: 0xff2030, side: THREE.DoubleSide, transparent: true, opacity: 0.45, depthWrite: false };
    return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial(look));
  }

  // Where all is now: joints in rad, rail in m, the vehicle's x, y, yaw since its start; base_from_place, where it was
  // measured, and base_from_part once it was let go, as 16 numbers.
  pose({ joints, rail, laser, holding, vehicle, place: measured, part }) {
    if (!this.scene) return;
    const basePlace = measured ?? this.reckoned(vehicle);
    if (joints) this.joints.forEach((joint, k) => { joint.rotation.z = joints[k]; });
    if (rail !== null && rail !== undefined) this.carriage.position.copy(this.railWay).multiplyScalar(rail);
    this.sheet.visible = Boolean(laser);
    // The station stands still on the screen, the vehicle drives.
    if (basePlace) place(this.base, (basePlace.isMatrix4 ? basePlace.clone() : matrix(basePlace)).invert());
    this.follow();
    if (this.part) {
      const loose = part ?? null;
      const parent = loose ? this.base : this.flange;
      if (this.part.parent !== parent) parent.add(this.part);
      if (loose) {
        const size = this.part.geometry.parameters.depth;
        place(this.part, matrix(loose).multiply(new THREE.Matrix4().makeTranslation(0, 0, size / 2)));
      } else {
        place(this.part, this.partInClaw);
      }
      this.part.visible = Boolean(loose) || holding !== false;
    }
    this.wake();
  }

  // base_from_place by odometry from the job's start pose; null without a station or a reading.
  reckoned(vehicle) {
    const station = this.scene.station;
    if (!station || !vehicle) return null;
    const driven = new THREE.Matrix4().makeRotationZ(vehicle.yaw).setPosition(vehicle.x, vehicle.y, 0);
    return matrix(station.place_from_start).multiply(driven).multiply(matrix(this.scene.vehicle_from_base)).invert();
  }

  // What belongs to the present only: not shown beside an earlier run.
  showPresent(visible) {
    this.cloud.points.visible = visible;
    if (this.way) this.way.visible = visible;
    this.wake();
  }

  // The way that was planned: points in the base, m.
  path(points) {
    if (!this.way) return;
    this.way.geometry.dispose();
    this.way.geometry = new THREE.BufferGeometry().setFromPoints(points.map((p) => new THREE.Vector3(...p)));
    this.wake();
  }

  // Look at the whole "cell", vehicle and station, or at the "place" from near.
  view(what) {
    const base = new THREE.Vector3().setFromMatrixPosition(this.base.matrix);
    const near = what === 'place' || !this.scene?.station;
    this.looked = what === 'cell' ? base : null;
    const back = Math.max(1, 1.25 / this.camera.aspect);
    if (what === 'place') {
      this.controls.target.set(0, 0, 0.01);
      this.camera.position.set(-0.11, -0.2, 0.15).multiplyScalar(back).add(this.controls.target);
    } else {
      const apart = near ? 0 : base.length();
      this.controls.target.copy(base).multiplyScalar(near ? 1 : 0.75).setZ(0);
      this.camera.position.set(-1.3, -1.95, 1.15).multiplyScalar(back * (0.72 + 0.35 * apart)).add(this.controls.target);
    }
    this.controls.update();
    this.wake();
  }

  // The view goes along with a vehicle that has driven a piece.
  follow() {
    if (!this.looked) return;
    const base = new THREE.Vector3().setFromMatrixPosition(this.base.matrix);
    if (base.distanceTo(this.looked) > 0.05) this.view('cell');
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.wake();
  }

  // Draw soon, but at most twenty times a second, and not at all while nothing changes.
  wake() {
    if (this.asked) return;
    this.asked = true;
    const wait = Math.max(0, this.drawn + FRAME_MS - performance.now());
    setTimeout(() => requestAnimationFrame(() => {
      this.asked = false;
      this.drawn = performance.now();
      if (this.stage.clientWidth) this.renderer.render(this.world, this.camera);
    }), wait);
  }
}

function sight([x, y, z]) {
  const points = [];
  for (const [a, b] of [[1, 1], [1, -1], [-1, -1], [-1, 1]]) points.push(0, 0, 0, a * x, b * y, z);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(points, 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: 0x7c8aa0, transparent: true, opacity: 0.35 }));
}

// Chassis and wheels, for the eye only: below the deck, on the floor that the vehicle's frame stands on.
function vehicle() {
  const dark = new THREE.MeshLambertMaterial({ color: 0x2d3440 });
  const chassis = new THREE.Mesh(new THREE.BoxGeometry(0.95, 0.56, 0.16), dark);
  chassis.position.set(0, 0, 0.17);
  const wheels = [-0.3, 0.3].flatMap((x) => [-0.29, 0.29].map((y) => {
    const wheel = new THREE.Mesh(new THREE.CylinderGeometry(0.11, 0.11, 0.09, 20), dark);
    wheel.position.set(x, y, 0.11);
    return wheel;
  }));
  return [chassis, ...wheels];
}
