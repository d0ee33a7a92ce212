// The lists beside the photo: points with their estimates from the marks, and the photos of a point.

export const element = (tag, attributes = {}, ...children) => {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child != null && child !== ""));
  return made;
};

export function metres(value) {
  if (value == null || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 10) return `${value.toFixed(0)} m`;
  if (size >= 0.995) return `${value.toFixed(1)} m`;
  return size >= 0.00995 ? `${(value * 100).toFixed(size >= 0.0995 ? 0 : 1)} cm` : `${(value * 1000).toFixed(0)} mm`;
}

export function showEstimate(root, overview) {
  root.replaceChildren(element("h2", {}, "Fit of the marks"));
  if (!overview.placed) {
    root.append(element("p", {}, "No frame yet: mark three points, each in two photos or more."));
  } else {
    const [horizontal, vertical] = overview.expected_m ?? [NaN, NaN];
    const row = (title, h, v, count) =>
      element("tr", {}, element("th", {}, title), element("td", {}, count ?? ""), element("td", {}, metres(h)), element("td", {}, metres(v)));
    const head = ["", "points", "horizontal", "height"].map((text) => element("th", {}, text));
    const table = element("table", {}, element("tr", {}, ...head));
    const { control, check } = overview.tables;
    if (control) table.append(row("control, rms", control.rmse_horizontal_m, control.rmse_up_m, control.count));
    if (check) table.append(row("check, rms", check.rmse_horizontal_m, check.rmse_up_m, check.count));
    table.append(row("expected (σ)", horizontal, overview.heights_tied ? vertical : NaN));
    root.append(table, element("p", { class: "faint" }, `A pixel is ${metres(overview.gsd_m)} on the ground.`));
    if (!overview.heights_tied) root.append(element("p", {}, "Heights are not tied to the survey yet: mark one point in two photos."));
  }
  for (const warning of overview.warnings) root.append(element("p", { class: "warning" }, warning));
}

export function showPoints(root, overview, chosen, wanted, choose) {
  const rows = overview.points.map((point, number) => {
    const [state, text] = stateOf(point, wanted);
    const size = point.residual_m && Math.hypot(...point.residual_m.map((value) => value ?? 0));
    return element(
      "li",
      { class: state, "aria-current": number === chosen ? "true" : null, title: title(point), onclick: () => choose(number) },
      element("strong", {}, point.name),
      element("span", { class: "role" }, point.role === "check" ? "check" : point.role === "left_out" && point.marks > 1 ? "left out" : ""),
      element("span", { class: "count" }, text),
      element("span", { class: "off" }, size == null ? "" : metres(size)),
    );
  });
  root.replaceChildren(...rows);
  root.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
}

function stateOf(point, wanted) {
  const count = `${point.marks} of ${point.marks + point.left}`;
  if (point.wrong || (point.role === "left_out" && point.marks > 1)) return ["wrong", count];
  if (point.marks >= Math.min(wanted, point.marks + point.left) && point.marks > 1) return ["done", count];
  return [point.marks ? "begun" : "open", count];
}

function title(point) {
  const [x, y, z] = point.coordinates;
  const lines = [`${point.name}: ${x}  ${y}  ${z ?? "(no height)"}`];
  if (point.residual_m) lines.push(`estimated minus surveyed: ${point.residual_m.map(metres).join(", ")} (east, north, up)`);
  if (point.found) lines.push(`${point.found} of ${point.marks} marks were detected automatically`);
  if (point.why) lines.push(point.why);
  if (point.wrong) lines.push(`${point.wrong} of its marks disagree with the others`);
  return lines.join("\n");
}

export const isLeft = (row) => row.predicted != null && !row.mark && !row.hidden && !row.doubtful;

const FOUND = "detected automatically. Move it to make it your mark; Del rejects it.";

function stateOfPhoto(row) {
  if (row.mark) return !row.agrees ? "wrong" : row.found ? "found" : "marked";
  return row.hidden ? "hidden" : "open";
}

export function showPhotos(root, rows, chosen, choose) {
  const groups = [
    ["marked", (row) => row.mark && !row.found],
    ["found", (row) => row.found],
    ["to do", (row) => isLeft(row)],
    ["perhaps", (row) => row.predicted && !row.mark && !row.hidden && row.doubtful],
    ["not visible", (row) => row.hidden],
    ["elsewhere", (row) => !row.predicted && !row.mark && !row.hidden],
  ];
  root.replaceChildren();
  for (const [name, belongs] of groups) {
    const members = rows.filter(belongs);
    if (!members.length) continue;
    root.append(element("li", { class: "group" }, `${name} ${members.length}`));
    for (const row of members) {
      const off = row.residual_px && Math.hypot(...row.residual_px);
      const current = row.photo === chosen ? "true" : null;
      root.append(
        element(
          "li",
          { class: `photo ${stateOfPhoto(row)}`, "aria-current": current, title: row.found ? FOUND : null, onclick: () => choose(row.photo) },
          element("span", {}, row.name),
          element("span", { class: "off" }, off == null ? "" : `${off.toFixed(1)} px`),
        ),
      );
    }
  }
  root.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
}
