// node bundle.mjs OUTFILE, run in the folder that has node_modules: bundles draw.js and all its imports into one script.
import { createRequire } from "node:module";
import { join } from "node:path";

const here = process.cwd();
const { build } = createRequire(join(here, "package.json"))("esbuild");
await build({
  entryPoints: [join(import.meta.dirname, "draw.js")],
  outfile: process.argv[2],
  bundle: true,
  format: "iife",
  target: "es2022",
  nodePaths: [join(here, "node_modules")],
  logLevel: "warning",
});
