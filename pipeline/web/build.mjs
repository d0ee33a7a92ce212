// Bundles each page's script and style (src/*.js, src/*.css) into a file of its own in dist/, including the licences of
// the packages in it, since pages are redistributed.
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

const modules = join(import.meta.dirname, "node_modules");
const facts = (name) => JSON.parse(readFileSync(join(modules, name, "package.json"), "utf8"));
for (const [path, { inputs }] of Object.entries(metafile.outputs)) {
  const packages = new Set(Object.keys(inputs).map((name) => name.match(/node_modules\/((?:@[^/]+\/)?[^/]+)/)?.[1]));
  for (const name of packages) { // grows while iterating: a package's bundle may contain its dependencies
    if (name) for (const other of Object.keys(facts(name).dependencies ?? {})) packages.add(other);
  }
  const licences = [...packages].filter(Boolean).sort().map((name) => {
    const text = readFileSync(join(modules, name, "LICENSE"), "utf8").replaceAll("*/", "* /").trim();
    return `${name} ${facts(name).version}\n${text}`;
  });
  if (licences.length) writeFileSync(path, `/*! With:\n\n${licences.join("\n\n")}\n*/\n${readFileSync(path, "utf8")}`);
}
