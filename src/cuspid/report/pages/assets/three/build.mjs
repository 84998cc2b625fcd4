// Makes three-core.min.js and three.min.js of three.js' own modules, without what the viewer does not use; see README.md.
import { readFileSync } from "node:fs";
import { build } from "esbuild";

/** Names that a module imports from another one. */
const imported = (text, from) => {
  const [, list] = text.match(new RegExp(`import\\s*{([^}]*)}\\s*from\\s*['"]${from}['"]`));
  return list.split(",").map((name) => name.trim().split(" as ")[0]).filter(Boolean);
};

const read = (name) => readFileSync(`node_modules/three/${name}`, "utf8");
const renderer = imported(read("build/three.module.js"), "./three.core.js");
const controls = imported(read("examples/jsm/controls/TrackballControls.js"), "three");
const [, ours] = readFileSync("viewer-parts.mjs", "utf8").match(/export {([^}]*)} from "three";/);
const viewer = ours.split(",").map((name) => name.trim()).filter((name) => name !== "WebGLRenderer");
const names = [...new Set([...renderer, ...controls, ...viewer])].sort().join(", ");

const common = { bundle: true, minify: true, format: "iife", target: "es2020", legalComments: "inline" };
const coreFromGlobal = {
  name: "core-from-global",
  setup(each) {
    each.onResolve({ filter: /three\.core\.js$/ }, () => ({ path: "core", namespace: "global" }));
    each.onLoad({ filter: /.*/, namespace: "global" }, () => ({ contents: "module.exports = globalThis.THREE_CORE;" }));
  },
};
const stdin = { contents: `export { ${names} } from "./node_modules/three/build/three.core.js";`, resolveDir: "." };
await build({ ...common, stdin, globalName: "THREE_CORE", outfile: "three-core.min.js" });
const entryPoints = ["viewer-parts.mjs"];
await build({ ...common, entryPoints, globalName: "THREE", plugins: [coreFromGlobal], outfile: "three.min.js" });
