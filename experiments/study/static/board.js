// Draws boards: a board is a list of pictures' numbers, one a tile (experiments/study/pictures.py).

const BOLD_STROKE = 0.025;

function fillAndStroke(context, [fill, stroke, width, opacity]) {
  context.globalAlpha = opacity;
  if (fill) {
    context.fillStyle = fill;
    context.fill();
  }
  if (stroke) {
    context.strokeStyle = stroke;
    context.lineWidth = width;
    context.stroke();
  }
  context.globalAlpha = 1;
}

function path(context, points, closed) {
  context.beginPath();
  for (let i = 0; i < points.length; i += 2) {
    if (i === 0) context.moveTo(points[0], points[1]);
    else context.lineTo(points[i], points[i + 1]);
  }
  if (closed) context.closePath();
}

const DRAW = {
  r(context, [x, y, width, height, radius, ...paint]) {
    context.beginPath();
    context.roundRect(x, y, width, height, radius);
    fillAndStroke(context, paint);
  },
  e(context, [x, y, rx, ry, ...paint]) {
    context.beginPath();
    context.ellipse(x, y, rx, ry, 0, 0, 2 * Math.PI);
    fillAndStroke(context, paint);
  },
  p(context, [points, ...paint]) {
    path(context, points, true);
    fillAndStroke(context, paint);
  },
  l(context, [points, stroke, width, opacity]) {
    context.lineCap = opacity < 1 ? "butt" : "round";
    path(context, points, false);
    fillAndStroke(context, [null, stroke, width, opacity]);
  },
  a(context, [x, y, radius, start, end, stroke, width]) {
    const angle = (degrees) => ((degrees - 90) * Math.PI) / 180;
    context.lineCap = "round";
    context.beginPath();
    context.arc(x, y, radius, angle(start), angle(end), end < start);
    fillAndStroke(context, [null, stroke, width, 1]);
  },
  t(context, [x, y, size, text, fill, anchor, bold]) {
    context.font = `${size}px Aileron, Helvetica, Arial, sans-serif`;
    context.textAlign = { start: "left", middle: "center", end: "right" }[anchor];
    context.fillStyle = fill;
    context.fillText(text, x, y);
    if (bold) {
      context.strokeStyle = fill;
      context.lineWidth = 2 * BOLD_STROKE * size;
      context.strokeText(text, x, y);
    }
  },
};

export class Board {
  // stage: an element with data-board (where the tiles are), .board, .score, .step and .time.
  constructor(stage) {
    this.stage = stage;
    this.where = JSON.parse(stage.dataset.board);
    this.canvas = stage.querySelector(".board");
    this.pictures = new Map();
    this.shown = [];
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
  }

  resize() {
    const { width, height } = this.where;
    this.canvas.style.aspectRatio = `${width} / ${height}`;
    const pixels = Math.max(1, Math.round(this.canvas.clientWidth * window.devicePixelRatio));
    if (pixels === this.canvas.width) return;
    this.canvas.width = pixels;
    this.canvas.height = Math.round((pixels * height) / width);
    this.shown.forEach((_, tile) => this.drawTile(tile));
  }

  // message: what the server says of a step.
  show(message) {
    for (const [number, picture] of Object.entries(message.pictures ?? {})) {
      this.pictures.set(Number(number), picture);
    }
    for (const [tile, picture] of message.tiles) {
      this.shown[tile] = picture;
      this.drawTile(tile);
    }
    this.stage.querySelector(".score").textContent = message.score;
    this.stage.querySelector(".step").textContent = message.step;
    this.stage.querySelector(".time").value = message.step;
  }

  drawTile(tile) {
    const context = this.canvas.getContext("2d");
    const scale = this.canvas.width / this.where.width;
    const [x, y, width, height] = this.where.tiles[tile];
    // Whole pixels, so that neighbours share their edges.
    const edge = (value) => Math.round(value * scale);
    context.save();
    context.beginPath();
    context.rect(edge(x), edge(y), edge(x + width) - edge(x), edge(y + height) - edge(y));
    context.clip();
    context.fillStyle = this.where.background;
    context.fill();
    context.translate(edge(x), edge(y));
    context.scale(scale, scale);
    context.lineJoin = "round";
    for (const [kind, ...shape] of this.pictures.get(this.shown[tile])) DRAW[kind](context, shape);
    context.restore();
  }
}
