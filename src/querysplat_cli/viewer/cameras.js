// Cameras of photos, and the free one.
import { Matrix4, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const OPENGL_AXES = new Matrix4().makeScale(1, -1, -1);
const LOWEST_VIEW = (85 * Math.PI) / 180; // angle from straight up: just above the ground
const BELOW_PHOTOS = (10 * Math.PI) / 180;

// Shows what `view` shows: a pinhole camera with OpenCV's axes and an image of its own size. The image is as large as
// fits into the canvas (CSS pixels), in its middle. Returns the rectangle that it covers.
export function showView(camera, view, canvas) {
  const scale = Math.min(canvas.clientWidth / view.width, canvas.clientHeight / view.height);
  const left = (canvas.clientWidth - scale * view.width) / 2;
  const top = (canvas.clientHeight - scale * view.height) / 2;
  const pose = new Matrix4().fromArray(view.c2w.flat()).transpose().multiply(OPENGL_AXES);
  pose.decompose(camera.position, camera.quaternion, camera.scale);
  const [fx, fy, cx, cy] = [view.fx * scale, view.fy * scale, view.cx * scale + left, view.cy * scale + top];
  const [w, h, near, far] = [canvas.clientWidth, canvas.clientHeight, camera.near, camera.far];
  camera.projectionMatrix.set(
    (2 * fx) / w, 0, 1 - (2 * cx) / w, 0,
    0, (2 * fy) / h, (2 * cy) / h - 1, 0,
    0, 0, (near + far) / (near - far), (2 * near * far) / (near - far),
    0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.fov = (360 / Math.PI) * Math.atan(h / 2 / fy);
  camera.updateMatrixWorld();
  return { left, top, width: scale * view.width, height: scale * view.height };
}

// Controls that turn the camera around `middle`, seen from wherever it is when the user takes hold of it. `place` shows the
// photo once more at that moment: the canvas may have changed its size since the last frame.
export function freeControls(camera, canvas, manifest, { place, onTaken, onMoved }) {
  camera.up.fromArray(manifest.up);
  const controls = new OrbitControls(camera, canvas);
  controls.maxPolarAngle = lowestView(manifest);
  const middle = new Vector3().fromArray(manifest.middle);
  controls.free = false;
  controls.addEventListener("start", () => {
    if (controls.free) return;
    place();
    const forward = camera.getWorldDirection(new Vector3());
    const away = middle.clone().sub(camera.position).dot(forward);
    const distance = away > 0 ? away : middle.distanceTo(camera.position);
    controls.target.copy(camera.position).addScaledVector(forward, distance || 1);
    controls.free = true;
    freeProjection(camera, canvas);
    onTaken();
  });
  controls.addEventListener("change", () => controls.free && onMoved());
  return controls;
}

// How far down the camera may be turned, as an angle from straight up: a little below the lowest of the photos, so that a
// long drag does not end under the table. Without photos nothing says what is below.
function lowestView({ up, views }) {
  const direction = new Vector3().fromArray(up).normalize();
  const angles = views.map(({ c2w }) => new Vector3(-c2w[0][2], -c2w[1][2], -c2w[2][2]).angleTo(direction));
  return angles.length ? Math.min(Math.PI, Math.max(LOWEST_VIEW, Math.max(...angles) + BELOW_PHOTOS)) : Math.PI;
}

export function freeProjection(camera, canvas) {
  camera.aspect = canvas.clientWidth / canvas.clientHeight;
  camera.updateProjectionMatrix();
}
