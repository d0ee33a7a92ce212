// What a person drops or chooses: folders are walked, and files are sorted into what a run uses and what it does not.

const DEEPEST = 12; // folders below the dropped one: a disk dropped by mistake ends the walk
const MOST_FILES = 50_000;
const HIDDEN = /(^|\/)[._]/; // as the run leaves them out: .DS_Store, ._DJI_0001.JPG
const SYSTEM = /(^|\/)(Thumbs\.db|desktop\.ini|__MACOSX)(\/|$)/i;
const SUBTITLES = "srt"; // beside a film: positions
const MASK_FOLDER = /(^|\/)masks\//;

/** Thrown where a drop cannot be a capture; the text is for the person. */
export class UnfitDropError extends Error {}

/** All files of a drop: `[{ path, file }]`, paths relative to what was dropped. Entries must be taken synchronously. */
export async function droppedFiles(transfer, onProgress) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return plainFiles(transfer.files);
  const found = [];
  for (const entry of entries) await walk(entry, "", 0, found, onProgress);
  return found;
}

/** All files of a file input; with webkitdirectory they have paths. */
export const plainFiles = (files) => [...files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));

async function walk(entry, above, depth, found, onProgress) {
  const path = above ? `${above}/${entry.name}` : entry.name;
  if (found.length > MOST_FILES || depth > DEEPEST) {
    throw new UnfitDropError(`This has more than ${MOST_FILES.toLocaleString("en")} files, or folders in folders without end. Drop the folder of one capture.`);
  }
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    found.push({ path, file });
    if (found.length % 100 === 0) onProgress?.(found.length);
    return;
  }
  const reader = entry.createReader();
  for (;;) { // a reader gives a hundred entries at a time
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) break;
    for (const child of some) await walk(child, path, depth + 1, found, onProgress);
  }
}

/**
 * Sort files into a capture.
 *
 * `accepted` comes from the node: suffixes of photos, raws and films, and names of survey files with what each is. A node
 * has one folder a job: photos of the same name in several folders get their folder's name in front, and
 * `masks/NAME.png` becomes `NAME_mask.png`, which is what a run calls it beside the photo. Raws of photos that are there
 * are left out; so are films, unless the drop is one film.
 */
export function capture(found, accepted) {
  const seen = found.filter(({ path }) => !HIDDEN.test(path) && !SYSTEM.test(path));
  const root = sharedFolder(seen.map(({ path }) => path));
  const photos = [], raws = [], films = [], inMasks = [], survey = [], others = [];
  for (const { path, file } of seen) {
    const name = path.slice(root.length);
    const base = name.split("/").at(-1).toLowerCase();
    const suffix = suffixOf(base);
    if (accepted.survey[base]) survey.push({ name: base, file, what: accepted.survey[base] });
    else if (accepted.raws.includes(suffix)) raws.push({ name, file });
    else if (accepted.films.includes(suffix) || suffix === SUBTITLES) films.push({ name, file });
    else if (!accepted.photos.includes(suffix)) others.push({ name, file });
    else (MASK_FOLDER.test(name) ? inMasks : photos).push({ name, file });
  }
  const developed = new Set(photos.map(({ name }) => stemOf(name)));
  for (const raw of raws) (developed.has(stemOf(raw.name)) ? others : photos).push(raw);
  const isFilm = !photos.length && films.filter(({ name }) => suffixOf(name.toLowerCase()) !== SUBTITLES).length === 1;
  for (const film of films) (isFilm ? photos : others).push(film);
  flatten(photos);
  const owners = ownersOf(photos);
  const masks = inMasks.filter((mask) => named(mask, owners) || !others.push(mask));
  const names = new Set();
  const files = [...photos, ...masks, ...survey].filter((each) => (names.has(each.name) ? !others.push(each) : names.add(each.name)));
  return { title: root.split("/").at(-2) ?? "", photos, masks, survey, others, files };
}

const suffixOf = (name) => (name.includes(".") ? name.split(".").at(-1) : "");
const stemOf = (name) => name.replace(/\.[^./]*$/, "");

/** Give photos names without folders; each keeps the one that it had as `path`. */
function flatten(photos) {
  const times = new Map();
  for (const photo of photos) {
    photo.path = photo.name;
    photo.name = photo.path.split("/").at(-1);
    times.set(photo.name.toLowerCase(), (times.get(photo.name.toLowerCase()) ?? 0) + 1);
  }
  for (const photo of photos) if (times.get(photo.name.toLowerCase()) > 1) photo.name = photo.path.replaceAll("/", "_");
}

/**
 * Name a mask after its photo; false if there is none. `masks/a/x.png`, `a/masks/x.png` and `x.JPG.png` are a/x's, and a
 * folder `masks` beside that of the photos leaves their folder out.
 */
function named(mask, owners) {
  const path = mask.name.replace(MASK_FOLDER, "$1");
  const owner = owners.get(stemOf(path)) ?? owners.get(stemOf(stemOf(path))) ?? owners.get(stemOf(path.split("/").at(-1)));
  if (owner) mask.name = `${stemOf(owner.name)}_mask.${suffixOf(path)}`;
  return owner != null;
}

/** Photos by path, by path without suffix and, where only one has it, by name without folder and suffix. */
function ownersOf(photos) {
  const owners = new Map();
  for (const photo of photos) {
    const stem = stemOf(photo.path.split("/").at(-1));
    owners.set(stem, owners.has(stem) ? null : photo);
  }
  for (const photo of photos) owners.set(stemOf(photo.path), photo).set(photo.path, photo);
  return owners;
}

function sharedFolder(paths) {
  if (!paths.length) return "";
  const folders = paths.map((path) => path.split("/").slice(0, -1));
  const shared = folders.reduce((common, each) => common.slice(0, lengthShared(common, each)));
  if (shared.at(-1) === "masks") shared.pop(); // masks are masks by the folder's name
  return shared.length ? `${shared.join("/")}/` : "";
}

function lengthShared(one, other) {
  let length = 0;
  while (length < one.length && length < other.length && one[length] === other[length]) length++;
  return length;
}
