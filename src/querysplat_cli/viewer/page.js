// The page: photos to step through, filters, depth, and the scene while a run makes it.
import { freeControls, freeProjection, showView } from "querysplat/cameras";
import { SplatView } from "querysplat/splats";

const POLL_MILLISECONDS = 1500;
const KEYS = { ArrowLeft: "previous", ArrowRight: "next", r: "reset", d: "depth" };
const element = (id) => document.getElementById(id);

// `resource(name, version)` gives the bytes of a file by its name.
export async function show(resource) {
  let manifest = await readManifest(resource);
  while (manifest.live && !manifest.gaussians) {
    element("message").textContent = manifest.state;
    await new Promise((done) => setTimeout(done, POLL_MILLISECONDS));
    manifest = await readManifest(resource);
  }
  const page = new Page(resource, manifest);
  const wanted = Number(location.hash.slice(1)) - 1; // #3 is the third photo
  page.step(wanted >= 0 && wanted < manifest.views.length ? wanted : manifest.first);
  await page.load(manifest);
  if (manifest.live) page.follow();
}

async function readManifest(resource) {
  return JSON.parse(new TextDecoder().decode(await resource("scene.json", Date.now())));
}

class Page {
  constructor(resource, manifest) {
    this.resource = resource;
    this.manifest = manifest;
    this.index = manifest.first;
    this.urls = {}; // of the photos that were shown, by name
    this.loaded = null; // the version of the Gaussians on the canvas
    this.canvas = element("canvas");
    this.view = new SplatView(this.canvas, manifest);
    const { camera } = this.view;
    this.controls = freeControls(camera, this.canvas, manifest, {
      place: () => this.place(),
      onTaken: () => this.label(),
      onMoved: () => this.view.draw(),
    });
    document.title = `${manifest.name} – querysplat`;
    element("name").textContent = manifest.name;
    this.connect();
  }

  async load(manifest) {
    const old = this.manifest.views;
    this.manifest = manifest;
    element("state").hidden = !manifest.state;
    element("state").textContent = manifest.state;
    if (manifest.version !== this.loaded) {
      await this.view.load(await this.resource(manifest.gaussians, manifest.version), manifest.kind);
      this.loaded = manifest.version;
      element("message").hidden = true;
    }
    if (manifest.views.length !== old.length && !this.controls.free) this.step(manifest.first);
  }

  // Follows a run until it ends or cannot be reached any more.
  follow() {
    setTimeout(async () => {
      const manifest = await readManifest(this.resource).catch(() => null);
      if (manifest) await this.load(manifest);
      else element("state").textContent = "The run cannot be reached any more.";
      if (manifest?.live) this.follow();
    }, POLL_MILLISECONDS);
  }

  // The camera of photo `index`; the one outside the scene where there are no photos.
  step(index) {
    const { views } = this.manifest;
    if (views.length) this.index = (index + views.length) % views.length;
    this.controls.free = false;
    this.place();
    this.label();
    if (views.length) this.showPhoto(views[this.index]);
    this.view.draw();
  }

  place() {
    const { views, outside } = this.manifest;
    const place = showView(this.view.camera, views[this.index] ?? outside, this.canvas);
    for (const [side, pixels] of Object.entries(place)) element("overlay").style[side] = `${pixels}px`;
  }

  async showPhoto(view) {
    if (!view.photo) return;
    this.urls[view.photo] ??= URL.createObjectURL(new Blob([await this.resource(view.photo)], { type: "image/jpeg" }));
    // Another photo may be asked for by now.
    if (this.manifest.views[this.index]?.photo !== view.photo) return;
    element("photo").src = element("overlay").src = this.urls[view.photo];
  }

  label() {
    const { views } = this.manifest;
    const view = views[this.index];
    const atPhoto = view && !this.controls.free;
    element("photos").hidden = !view;
    element("photo").hidden = element("blend-row").hidden = !view?.photo;
    const note = view?.held_out ? " (held out)" : "";
    element("where").textContent = atPhoto ? `${this.index + 1}/${views.length} ${view.name}${note}` : "free view";
    element("overlay").hidden = !(atPhoto && view.photo);
    element("overlay").style.opacity = element("blend").value;
  }

  filter() {
    const [low, high] = this.manifest.sizes.map(Math.log);
    const share = Number(element("size").value);
    const largest = share < 1 ? Math.exp(low + share * (high - low)) : Infinity;
    const leastOpacity = Number(element("opacity").value);
    element("opacity-value").textContent = `${Math.round(100 * leastOpacity)} %`;
    element("size-value").textContent = share < 1 ? `${largest.toPrecision(2)} units` : "any";
    this.view.set({ leastOpacity, largestSize: largest, depth: element("depth").checked ? 1 : 0 });
  }

  connect() {
    element("previous").onclick = () => this.step(this.index - 1);
    element("next").onclick = () => this.step(this.index + 1);
    element("reset").onclick = () => this.step(this.manifest.first);
    element("blend").oninput = () => this.label();
    for (const id of ["opacity", "size", "depth"]) element(id).oninput = () => this.filter();
    this.filter();
    new ResizeObserver(() => {
      if (this.controls.free) freeProjection(this.view.camera, this.canvas);
      else this.place();
      this.view.draw();
    }).observe(this.canvas);
    window.addEventListener("keydown", (event) => {
      if (event.target.type === "range" || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "h") document.body.classList.toggle("bare");
      else element(KEYS[event.key])?.click();
    });
  }
}
