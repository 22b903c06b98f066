// The Gaussians on the canvas, by Spark.
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { SparkRenderer, SplatFileType, SplatMesh, dyno } from "@sparkjsdev/spark";

const KINDS = { ply: SplatFileType.PLY, spz: SplatFileType.SPZ, sog: SplatFileType.PCSOGSZIP };
// The conventions of querysplat's own splatter (splat/conventions.py).
const LEAST_ALPHA = 1 / 255;
const LOW_PASS = 0.3;

export class SplatView {
  constructor(canvas, manifest) {
    const { near, far } = manifest;
    this.camera = new PerspectiveCamera(50, 1, near, far);
    this.scene = new Scene();
    this.renderer = new WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: () => this.draw(),
      accumExtSplats: true,
      maxStdDev: Math.sqrt(2 * Math.log(1 / LEAST_ALPHA)),
      minAlpha: LEAST_ALPHA,
      maxPixelRadius: 8192,
      preBlurAmount: LOW_PASS,
      sortRadial: false,
      enableLod: false,
    });
    this.scene.add(this.spark);
    this.leastOpacity = dyno.dynoFloat(0);
    this.largestSize = dyno.dynoFloat(Infinity);
    this.depth = dyno.dynoFloat(0);
    this.logNear = dyno.dynoFloat(Math.log(manifest.depth[0]));
    this.logFar = dyno.dynoFloat(Math.log(manifest.depth[1]));
    this.mesh = null;
    this.waiting = false;
  }

  // Shows the Gaussians of a file in place of those before.
  async load(bytes, kind) {
    const mesh = new SplatMesh({ fileBytes: new Uint8Array(bytes), fileType: KINDS[kind], extSplats: true, lod: false });
    await mesh.initialized;
    if (kind === "spz") mesh.quaternion.set(1, 0, 0, 0); // its y points up, that of a .ply down
    mesh.enableWorldToView = true;
    mesh.worldModifier = this.modifier(mesh);
    mesh.updateGenerator();
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.mesh = mesh;
    this.scene.add(mesh);
    this.draw();
  }

  // Hides Gaussians that are faint or large, and paints depth in place of colour where that is asked for.
  modifier(mesh) {
    return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
      const { center, scales, rgb, opacity } = dyno.splitGsplat(gsplat).outputs;
      const { x, y, z } = dyno.split(scales).outputs;
      const size = dyno.max(dyno.max(x, y), z);
      const shown = dyno.and(
        dyno.greaterThanEqual(opacity, this.leastOpacity),
        dyno.lessThanEqual(size, this.largestSize),
      );
      const ahead = dyno.neg(dyno.split(mesh.context.worldToView.apply(center)).outputs.z);
      const range = dyno.sub(this.logNear, this.logFar);
      const nearness = dyno.div(dyno.sub(dyno.log(dyno.max(ahead, dyno.dynoConst("float", 1e-9))), this.logFar), range);
      const grey = dyno.clamp(nearness, dyno.dynoConst("float", 0), dyno.dynoConst("float", 1));
      const colour = dyno.combine({ vectorType: "vec3", x: grey, y: grey, z: grey });
      const painted = dyno.mix(rgb, colour, this.depth);
      const visible = dyno.select(shown, opacity, dyno.dynoConst("float", 0));
      return { gsplat: dyno.combineGsplat({ gsplat, rgb: painted, opacity: visible }) };
    });
  }

  // Changes what is shown: {leastOpacity, largestSize, depth}.
  set(values) {
    for (const [name, value] of Object.entries(values)) this[name].value = value;
    this.mesh?.updateVersion();
    this.draw();
  }

  // Draws soon, and again until the order of the Gaussians is that of the camera.
  draw() {
    document.documentElement.dataset.state = "busy";
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const canvas = this.renderer.domElement;
      this.renderer.setPixelRatio(window.devicePixelRatio);
      this.renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
      this.renderer.render(this.scene, this.camera);
      const settled = this.mesh && !this.waiting && !this.spark.sorting && !this.spark.sortDirty;
      if (settled) document.documentElement.dataset.state = "settled";
    });
  }
}
