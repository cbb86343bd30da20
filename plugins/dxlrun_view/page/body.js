// 3-D view of the robot: its URDF, rotated by the IMU, and a ghost at the goal positions.
import { AmbientLight, Box3, Color, DirectionalLight, GridHelper, Group, HemisphereLight, Matrix4, Mesh,
  MeshStandardMaterial, Object3D, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";
import { ColladaLoader } from "three/examples/jsm/loaders/ColladaLoader.js";
import { STLLoader } from "three/examples/jsm/loaders/STLLoader.js";
import URDFLoader from "urdf-loader";

export class Body {
  constructor(canvas, fetchMesh, missing) {
    this.canvas = canvas;
    this.fetchMesh = fetchMesh;
    this.missing = missing;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new Scene();
    this.scene.up.set(0, 0, 1);
    this.camera = new PerspectiveCamera(35, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new HemisphereLight(0xffffff, 0x8090a0, 1.6), new AmbientLight(0xffffff, 0.5));
    const sun = new DirectionalLight(0xffffff, 1.8);
    sun.position.set(1.5, -2, 3);
    this.scene.add(sun);
    this.world = new Group();
    this.scene.add(this.world);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => { this.dirty = true; });
    this.controls.addEventListener("start", () => { this.touched = true; });
    this.grip = new Object3D();
    this.drag = new TransformControls(this.camera, canvas);
    this.drag.setSize(0.8);
    this.drag.addEventListener("change", () => { this.dirty = true; });
    this.drag.addEventListener("dragging-changed", ({ value }) => { this.controls.enabled = !value; });
    this.drag.addEventListener("objectChange", () => this.dragged());
    this.scene.add(this.drag.getHelper());
    this.dirty = true;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.colour();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colour());
    const draw = () => {
      if (this.dirty) { this.dirty = false; this.renderer.render(this.scene, this.camera); }
      requestAnimationFrame(draw);
    };
    draw();
  }

  colour() {
    const style = getComputedStyle(document.documentElement);
    this.grid?.removeFromParent();
    const line = new Color(style.getPropertyValue("--line").trim());
    this.grid = new GridHelper(2, 20, line, line);
    this.grid.rotation.x = Math.PI / 2;
    this.grid.position.z = this.floor ?? 0;
    this.scene.add(this.grid);
    this.dirty = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.robot && !this.touched) this.fit();
    this.dirty = true;
  }

  // Show a URDF. `link` is the link of the IMU, or an empty text.
  load(urdf, link) {
    this.grab(null);
    this.world.clear();
    this.robot = this.parse(urdf, false);
    this.ghost = this.parse(urdf, true);
    this.world.add(this.robot, this.ghost);
    this.turned = link && turnedLink(this.robot, link);
    this.ghostTurned = link && turnedLink(this.ghost, link);
    this.fit();
  }

  parse(urdf, ghost) {
    const loader = new URDFLoader();
    loader.loadMeshCb = (path, manager, done) => {
      this.fetchMesh(path).then((data) => {
        done(meshOf(path, data));
        if (ghost) fade(robot);
        if (!this.touched) this.fit();
        this.dirty = true;
      }).catch((error) => { this.missing(error); done(new Group()); });
    };
    loader.workingPath = "";
    loader.packages = (name) => `package://${name}`;
    const robot = loader.parse(urdf);
    if (ghost) fade(robot);
    return robot;
  }

  fit() {
    this.touched = false;
    this.robot.updateMatrixWorld(true);
    const box = new Box3().setFromObject(this.robot);
    if (box.isEmpty()) box.set(new Vector3(-0.2, -0.2, 0), new Vector3(0.2, 0.2, 0.4));
    const middle = box.getCenter(new Vector3());
    const size = box.getSize(new Vector3()).length();
    const distance = size / 2 / Math.tan(this.camera.fov * Math.PI / 360) / Math.min(1, this.camera.aspect) * 0.92;
    this.camera.near = distance / 100; this.camera.far = distance * 20;
    this.camera.position.copy(middle).add(new Vector3(0.85, -0.45, 0.35).normalize().multiplyScalar(distance));
    this.camera.updateProjectionMatrix();
    this.controls.target.copy(middle);
    this.controls.update();
    this.floor = box.min.z;
    this.grid.position.z = this.floor;
    const scale = 10 ** Math.round(Math.log10(size * 1.5));
    this.grid.scale.setScalar(scale);
    this.dirty = true;
  }

  // Show a handle at a tip, {tip, base} by link, or none for null.
  grab(handle) {
    this.drag.detach();
    this.grip.removeFromParent();
    this.handle = handle;
    if (handle) {
      (this.robot.links[handle.base] ?? this.robot).add(this.grip);
      this.drag.attach(this.grip);
      this.moveGripToTip();
    }
    this.dirty = true;
  }

  moveGripToTip() {
    this.robot.updateMatrixWorld(true);
    const { matrixWorld } = this.robot.links[this.handle.tip];
    this.grip.parent.matrixWorld.clone().invert().multiply(matrixWorld).decompose(this.grip.position, this.grip.quaternion, this.grip.scale);
  }

  // Return the place of the handle on the canvas, px.
  placeOfGrip() {
    const { x, y } = this.grip.getWorldPosition(new Vector3()).project(this.camera);
    return [(x + 1) / 2 * this.canvas.clientWidth, (1 - y) / 2 * this.canvas.clientHeight];
  }

  // Move the robot and its ghost. `positions` and `goals` are by joint, rad or m. `orientation` is the
  // quaternion [x, y, z, w] of the IMU in the world, or null.
  pose(positions, goals, orientation) {
    if (!this.robot) return;
    const moved = set(this.robot, positions) | set(this.ghost, goals);
    const far = Object.entries(goals).some(([name, goal]) => Math.abs(goal - positions[name]) > 0.02);
    const visible = this.showGhost !== false && far;
    const changed = this.ghost.visible !== visible;
    this.ghost.visible = visible;
    let turnedNow = false;
    if (orientation && this.turned) {
      turnedNow = turn(this.robot, this.turned, orientation) | turn(this.ghost, this.ghostTurned, orientation);
    }
    if (moved || changed || turnedNow) this.dirty = true;
  }
}

function set(robot, values) {
  let moved = false;
  for (const [name, value] of Object.entries(values)) {
    if (value !== null && robot.joints[name]) moved = robot.setJointValue(name, value) || moved;
  }
  return moved;
}

function fade(robot) {
  // The polygon offset hides the ghost where its faces coincide with those of the robot.
  const material = new MeshStandardMaterial({ color: 0xe08a1e, transparent: true, opacity: 0.4, depthWrite: false,
    polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 });
  robot.traverse((one) => { if (one instanceof Mesh) one.material = material; });
}

function meshOf(path, data) {
  if (/\.dae$/i.test(path)) return new ColladaLoader().parse(new TextDecoder().decode(data)).scene;
  if (/\.stl$/i.test(path)) return new Mesh(new STLLoader().parse(data), new MeshStandardMaterial({ color: 0x9aa4b0 }));
  throw new Error(`mesh ${path} has an unsupported format; convert it to .stl or .dae`);
}

// Return the link of the IMU and the object that its orientation rotates: the joint between odom and this link,
// or the whole robot if there is no such joint.
function turnedLink(robot, link) {
  const sensor = robot.links[link];
  if (!sensor) return null;
  const joint = sensor.parent;
  const own = joint?.isURDFJoint && joint.parent?.name === "odom";
  return { sensor, moved: own ? joint : robot };
}

function turn(robot, { sensor, moved }, [x, y, z, w]) {
  robot.updateMatrixWorld(true);
  const wanted = new Quaternion(x, y, z, w);
  const is = new Quaternion().setFromRotationMatrix(new Matrix4().extractRotation(sensor.matrixWorld));
  const parent = moved.parent.getWorldQuaternion(new Quaternion());
  const by = wanted.multiply(is.invert());
  if (Math.abs(by.w) > 1 - 1e-9) return false;
  const world = by.multiply(moved.getWorldQuaternion(new Quaternion()));
  moved.quaternion.copy(parent.invert().multiply(world));
  moved.matrixWorldNeedsUpdate = true;
  return true;
}
