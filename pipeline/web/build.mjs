// Bundles each page's script and style (src/*.js, src/*.css) into one file of its own in dist/.
import { readdirSync } from "node:fs";
import { join } from "node:path";
import { build } from "esbuild";

const src = join(import.meta.dirname, "src");
await build({
  entryPoints: readdirSync(src).filter((name) => /\.(js|css)$/.test(name)).map((name) => join(src, name)),
  outdir: join(import.meta.dirname, "dist"),
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  legalComments: "inline",
  logLevel: "warning",
});
