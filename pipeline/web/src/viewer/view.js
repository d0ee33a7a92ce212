// The viewpoint: position, direction and lens, in the world (z up).

import { Matrix4, Vector3 } from "three";

const WIDEST_RAD = (80 * Math.PI) / 180; // largest angle shown with a photo's lens in a window of another aspect ratio
const STEEPEST_RAD = (89.5 * Math.PI) / 180;
const MOVE_MS = 700;

export class View {
  /** @param {{near: number, far: number}} planes World units. */
  constructor(planes) {
    this.planes = planes;
    this.position = new Vector3();
    this.yaw = 0; // of the viewing direction, from east to north
    this.pitch = 0; // above the horizon
    this.roll = 0; // clockwise as seen from behind
    this.lens = { width: 4, height: 3, fx: 3, fy: 3, cx: 2, cy: 1.5 };
    this.size = { width: 1, height: 1 };
    this.changed = () => {};
  }

  /** World from camera (x right, y up, z back), 3×3 as columns right, up, back. */
  axes() {
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const forward = new Vector3(cy * cp, sy * cp, sp);
    const level = new Vector3(sy, -cy, 0);
    const upright = new Vector3().crossVectors(level, forward);
    const [sr, cr] = [Math.sin(this.roll), Math.cos(this.roll)];
    const right = level.clone().multiplyScalar(cr).addScaledVector(upright, -sr);
    const up = upright.multiplyScalar(cr).addScaledVector(level, sr);
    return { right, up, forward, back: forward.clone().negate() };
  }

  /** Set the direction from a camera's axes. */
  face(forward, right) {
    this.pitch = Math.asin(Math.max(-1, Math.min(1, forward.z)));
    if (Math.abs(forward.z) < 0.9999) {
      this.yaw = Math.atan2(forward.y, forward.x);
    } else {
      this.yaw = Math.atan2(right.x, -right.y); // straight down or up: assume no roll
    }
    this.roll = 0;
    const { right: level, up } = this.axes();
    this.roll = Math.atan2(-right.dot(up), right.dot(level));
  }

  /** The pose of a photo, with its lens. */
  poseOf(photo) {
    const to = new View(this.planes);
    const r = photo.rotation; // world from camera (x right, y down, z forward), row by row
    to.position.fromArray(photo.centre);
    to.face(new Vector3(r[2], r[5], r[8]), new Vector3(r[0], r[3], r[6]));
    to.lens = photo;
    return to;
  }

  take({ position, yaw, pitch, roll, lens }) {
    this.position.copy(position);
    Object.assign(this, { yaw, pitch, roll, lens });
    this.changed();
  }

  /** Move there, animated or at once (also if the user prefers reduced motion); then call `arrived`. */
  travel(to, atOnce = false, arrived = () => {}) {
    this.journey = null;
    if (atOnce || matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.take(to);
      arrived();
      return;
    }
    const from = { position: this.position.clone(), yaw: this.yaw, pitch: this.pitch, roll: this.roll };
    const turn = (a, b) => a + Math.atan2(Math.sin(b - a), Math.cos(b - a));
    const journey = { began: performance.now() };
    this.journey = journey;
    this.lens = to.lens;
    const step = () => {
      if (this.journey !== journey) return;
      const time = Math.min(1, (performance.now() - journey.began) / MOVE_MS);
      const share = time * time * (3 - 2 * time);
      if (time === 1) {
        this.journey = null;
        this.take(to);
        return arrived();
      }
      const mix = (a, b) => a + (b - a) * share;
      this.position.lerpVectors(from.position, to.position, share);
      this.yaw = mix(from.yaw, turn(from.yaw, to.yaw));
      this.pitch = mix(from.pitch, to.pitch);
      this.roll = mix(from.roll, turn(from.roll, to.roll));
      this.changed();
      requestAnimationFrame(step);
    };
    step();
  }

  /** Rotate by angles around a point or on the spot. Manual rotation levels the view. */
  turn(yaw, pitch, pivot = null) {
    this.journey = null;
    const before = this.axes();
    const offset = pivot ? this.position.clone().sub(pivot) : null;
    const local = offset && [offset.dot(before.right), offset.dot(before.up), offset.dot(before.back)];
    this.yaw += yaw;
    this.pitch = Math.max(-STEEPEST_RAD, Math.min(STEEPEST_RAD, this.pitch + pitch));
    this.roll *= 0.8;
    if (offset) {
      const { right, up, back } = this.axes();
      this.position.copy(pivot).addScaledVector(right, local[0]).addScaledVector(up, local[1]).addScaledVector(back, local[2]);
    }
    this.changed();
  }

  /** Translate in the world. */
  shift(offset) {
    this.journey = null;
    this.position.add(offset);
    this.changed();
  }

  /** Focal lengths and principal point in window pixels, showing the whole photo if the aspect ratio allows it. */
  intrinsics() {
    const { width, height, fx, fy, cx, cy } = this.lens;
    const [across, down] = [this.size.width / width, this.size.height / height];
    const narrow = 2 * Math.tan(WIDEST_RAD / 2);
    const wanted = Math.max(Math.min(across, down), this.size.width / (fx * narrow), this.size.height / (fy * narrow));
    const scale = Math.min(wanted, Math.max(across, down));
    return {
      fx: fx * scale,
      fy: fy * scale,
      cx: this.size.width / 2 + (cx - width / 2) * scale,
      cy: this.size.height / 2 + (cy - height / 2) * scale,
    };
  }

  /** The unit direction, in the world, of the ray through a window position in CSS pixels. */
  ray(x, y) {
    const { fx, fy, cx, cy } = this.intrinsics();
    const { right, up, forward } = this.axes();
    return forward.clone().addScaledVector(right, (x - cx) / fx).addScaledVector(up, (cy - y) / fy).normalize();
  }

  /** Window position of a world point, CSS pixels, and its depth (≤ 0: behind). */
  project(point) {
    const { fx, fy, cx, cy } = this.intrinsics();
    const { right, up, forward } = this.axes();
    const offset = new Vector3().subVectors(point, this.position);
    const depth = offset.dot(forward);
    return { x: cx + (fx * offset.dot(right)) / depth, y: cy - (fy * offset.dot(up)) / depth, depth };
  }

  /** Set up three's camera. */
  apply(camera) {
    const { fx, fy, cx, cy } = this.intrinsics();
    const { width, height } = this.size;
    const { right, up, back } = this.axes();
    camera.matrix.makeBasis(right, up, back).setPosition(this.position);
    camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
    const { near, far } = this.planes;
    camera.near = near;
    camera.far = far;
    camera.fov = (2 * Math.atan(height / 2 / fy) * 180) / Math.PI;
    camera.aspect = width / height;
    // prettier-ignore
    camera.projectionMatrix.copy(new Matrix4().set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, (near + far) / (near - far), (2 * near * far) / (near - far),
      0, 0, -1, 0,
    ));
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }
}
