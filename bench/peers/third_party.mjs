// Reads the files of `third_party.py` in a browser and posts the numbers that each library returns.
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { PLYLoader } from "three/addons/loaders/PLYLoader.js";

const C0 = 0.28209479177387814;
const list = (attribute) => Array.from({ length: attribute.count * attribute.itemSize }, (_, i) =>
  attribute.getComponent(Math.floor(i / attribute.itemSize), i % attribute.itemSize));
const wxyz = (xyzw) => xyzw.map((_, i) => xyzw[i - (i % 4) + ((i + 3) % 4)]);

function mesh(geometry) {
  return { vertices: list(geometry.attributes.position), faces: list(geometry.index) };
}

async function gltf(url) {
  const root = (await new GLTFLoader().loadAsync(url)).scene, out = {};
  root.updateMatrixWorld(true);
  root.traverse((node) => {
    if (!node.geometry) return;
    const own = node.geometry.clone(), get = (name) => list(own.attributes[`khr_gaussian_splatting:${name}`]);
    const turn = new THREE.Quaternion(), size = new THREE.Vector3(), add = (name, values) => (out[name] ??= []).push(...values);
    node.matrixWorld.decompose(new THREE.Vector3(), turn, size);
    own.attributes.position.applyMatrix4(node.matrixWorld);
    if (own.index) return Object.assign(out, mesh(own));
    const quats = get("rotation");
    for (let i = 0; i < quats.length; i += 4) new THREE.Quaternion().fromArray(quats, i).premultiply(turn).toArray(quats, i);
    add("means", list(own.attributes.position));
    add("quats", wxyz(quats));
    add("log_scales", get("scale").map((s) => Math.log(s * size.x)));
    add("opacities", get("opacity"));
    const still = node.matrixWorld.equals(new THREE.Matrix4()), degrees = still ? [0, 1, 2, 3] : [0];
    for (const l of degrees) for (let k = 0; k <= 2 * l; k++)
      if (own.attributes[`khr_gaussian_splatting:sh_degree_${l}_coef_${k}`]) add(`sh${l * l + k}`, get(`sh_degree_${l}_coef_${k}`));
  });
  return out;
}

async function ply(url) {
  const loader = new PLYLoader(), of = (start, n) => Array.from({ length: n }, (_, i) => `${start}_${i}`);
  const rest = Array.from({ length: 15 }, (_, k) => [`sh${k + 1}`, [0, 15, 30].map((c) => `f_rest_${k + c}`)]);
  loader.setCustomPropertyNameMapping({ quats: of("rot", 4), log_scales: of("scale", 3), logit_opacities: ["opacity"],
    sh0: of("f_dc", 3), ...Object.fromEntries(rest) });
  const own = await loader.loadAsync(url);
  if (own.index) return mesh(own);
  const { position, ...others } = own.attributes;
  return { means: list(position), ...Object.fromEntries(Object.entries(others).map(([name, a]) => [name, list(a)])) };
}

async function spark(url) {
  const { ExtSplats } = await import("@sparkjsdev/spark");
  const splats = await new ExtSplats({ url, fileName: url.split("/").pop() }).initialized;
  const out = { means: [], quats: [], log_scales: [], opacities: [], sh0: [] }, { sh1, sh2, sh3a, sh3b } = splats.extra;
  splats.forEachSplat((_, center, scales, q, opacity, color) => {
    out.means.push(...center);
    out.quats.push(q.w, q.x, q.y, q.z);
    out.log_scales.push(...scales.toArray().map(Math.log));
    out.opacities.push(opacity);
    out.sh0.push(...color.toArray().map((c) => (c - 0.5) / C0));
  });
  const unpack = (v) => [0, 1, 2].map((c) => (((v >>> (8 * c)) & 255) * 2 ** ((v >>> 27) - 15) * ((v >>> (24 + c)) & 1 ? -1 : 1)) / 255);
  [sh1, sh2, sh3a, sh3b].filter(Boolean).forEach((words, part) => {
    for (let k = 0; k < 4; k++) if (4 * part + k < 15)
      out[`sh${4 * part + k + 1}`] = Array.from({ length: splats.numSplats }, (_, i) => unpack(words[4 * i + k])).flat();
  });
  return out;
}

for (const [i, [how, name]] of JOBS.entries()) {
  const read = how === "Spark" ? spark : name.endsWith(".ply") ? ply : gltf;
  const body = await read(`/${name}`).catch((error) => ({ error: String(error) }));
  await fetch(`/${i}`, { method: "POST", body: JSON.stringify(body) });
}
