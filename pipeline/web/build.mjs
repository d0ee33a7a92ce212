// Bundles each page's script and style (src/*.js, src/*.css) into one file of its own in dist/, with the licences of
// what is in it: a page is handed on.
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { build } from "esbuild";

const src = join(import.meta.dirname, "src");
const { metafile } = await build({
  metafile: true,
  entryPoints: readdirSync(src).filter((name) => /\.(js|css)$/.test(name)).map((name) => join(src, name)),
  outdir: join(import.meta.dirname, "dist"),
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  legalComments: "inline",
  logLevel: "warning",
});

for (const [path, { inputs }] of Object.entries(metafile.outputs)) {
  const packages = new Set(Object.keys(inputs).map((name) => name.match(/node_modules\/((?:@[^/]+\/)?[^/]+)/)?.[1]));
  const licences = [...packages].filter(Boolean).sort().map((name) => {
    const folder = join(import.meta.dirname, "node_modules", name);
    const { version } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
    return `${name} ${version}\n${readFileSync(join(folder, "LICENSE"), "utf8").replaceAll("*/", "* /").trim()}`;
  });
  if (licences.length) writeFileSync(path, `/*! With:\n\n${licences.join("\n\n")}\n*/\n${readFileSync(path, "utf8")}`);
}
