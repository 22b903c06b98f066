// Makes the modules of the page known to the browser, and starts it.
// `querysplat view` serves everything by name. A file of `querysplat export` holds everything in elements whose ids
// are those names: base64 of gzip.
const MODULES = {
  "three": "lib/three.module.js",
  "three/addons/controls/OrbitControls.js": "lib/OrbitControls.js",
  "three/addons/postprocessing/Pass.js": "lib/Pass.js",
  "@sparkjsdev/spark": "lib/spark.module.min.js",
  "querysplat/cameras": "cameras.js",
  "querysplat/splats": "splats.js",
  "querysplat/page": "page.js",
};
const CORE = "lib/three.core.js"; // three.module.js imports it by a path, which blobs do not have

function held(name) {
  return document.getElementById(name);
}

// The bytes of a file by its name. `version` keeps the browser from showing an older one.
async function resource(name, version = 0) {
  const element = held(name);
  const answer = await fetch(element ? `data:application/gzip;base64,${element.textContent}` : `${name}?${version}`);
  if (!answer.ok) throw new Error(`${name}: ${answer.status}`);
  if (!element) return answer.arrayBuffer();
  return new Response(answer.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function moduleUrl(name, change = (text) => text) {
  if (!held(name)) return new URL(name, location.href).href;
  const text = change(new TextDecoder().decode(await resource(name)));
  return URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}

async function start() {
  const core = await moduleUrl(CORE);
  const imports = {};
  for (const [specifier, name] of Object.entries(MODULES)) {
    imports[specifier] = await moduleUrl(name, (text) => text.replaceAll("'./three.core.js'", `'${core}'`));
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  const page = await import("querysplat/page");
  await page.show(resource);
}

start().catch((error) => {
  held("message").hidden = false;
  held("message").textContent = `The scene cannot be shown: ${error.message}`;
  document.documentElement.dataset.state = "failed";
});
