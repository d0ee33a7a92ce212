// node validate.mjs FILE.glb, run in the folder that has node_modules: prints gltf-validator's report as JSON.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const validator = createRequire(join(process.cwd(), "package.json"))("gltf-validator");
const report = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 0 });
console.log(JSON.stringify({ version: report.validatorVersion, messages: report.issues.messages }));
