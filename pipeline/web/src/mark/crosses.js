// The overlay on a photo: the expected position of the point, its mark or detected target, and the pointer.

const INK = { expected: "#ffb000", marked: "#3ddc68", found: "#d08cff", moved: "#4cc2ff", wrong: "#ff5a5f" };
const GAP = 4; // screen pixels left free around the position itself
const ARM = 16;

export function paintOver(context, picture, row, moved) {
  if (picture.pointer) lines(context, picture);
  if (!row) return;
  if (row.line && !row.mark) path(context, picture, row.line);
  if (row.predicted && !row.mark) circle(context, picture, row.predicted, row.radius_px);
  if (row.predicted && row.mark) dot(context, picture.screenAt(row.predicted));
  if (moved && !row.mark) cross(context, picture.screenAt(moved), INK.moved);
  else if (!row.mark && row.predicted) cross(context, picture.screenAt(row.predicted), INK.expected);
  if (row.mark) cross(context, picture.screenAt(row.mark), inkOf(row));
}

const inkOf = (row) => (!row.agrees ? INK.wrong : row.found ? INK.found : INK.marked);

function stroke(context, colour, path) {
  context.beginPath();
  path();
  context.lineWidth = 3;
  context.strokeStyle = "rgba(0, 0, 0, 0.55)";
  context.stroke();
  context.lineWidth = 1.25;
  context.strokeStyle = colour;
  context.stroke();
}

// Cross hairs one device pixel wide over the whole photo, with a gap at the position itself.
function lines(context, picture) {
  const [x, y] = picture.pointer;
  context.save();
  context.globalAlpha = 0.7;
  stroke(context, "#ffffff", () => {
    for (const [a, b] of [[0, x - GAP * 3], [x + GAP * 3, picture.width]]) {
      context.moveTo(a, y);
      context.lineTo(b, y);
    }
    for (const [a, b] of [[0, y - GAP * 3], [y + GAP * 3, picture.height]]) {
      context.moveTo(x, a);
      context.lineTo(x, b);
    }
  });
  context.restore();
}

function cross(context, [x, y], colour) {
  stroke(context, colour, () => {
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + GAP * dx, y + GAP * dy);
      context.lineTo(x + ARM * dx, y + ARM * dy);
    }
  });
  context.fillStyle = colour;
  context.fillRect(x - 0.5, y - 0.5, 1, 1);
}

function circle(context, picture, place, radius) {
  const [x, y] = picture.screenAt(place);
  context.save();
  context.setLineDash([6, 5]);
  stroke(context, INK.expected, () => context.arc(x, y, Math.max(ARM + 4, radius * picture.zoom), 0, 2 * Math.PI));
  context.restore();
}

// The epipolar curve of the point's only mark in this photo: the point lies on it.
function path(context, picture, line) {
  context.save();
  context.globalAlpha = 0.8;
  stroke(context, INK.moved, () => line.forEach((place) => context.lineTo(...picture.screenAt(place))));
  context.restore();
}

function dot(context, [x, y]) {
  stroke(context, INK.expected, () => context.arc(x, y, 3, 0, 2 * Math.PI));
}
