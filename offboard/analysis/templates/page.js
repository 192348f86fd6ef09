// Draws every figure, and draws it again when the colour scheme or the width class changes.
const dark = matchMedia("(prefers-color-scheme: dark)");
const narrow = matchMedia("(max-width: 700px)");
const touch = matchMedia("(pointer: coarse)");
const LEGEND_ROW_PX = 20;

// The object that a JSON text describes, in the colours of the scheme.
function coloured(text) {
  return JSON.parse(!dark.matches ? text
    : text.replace(/#[0-9a-f]{6}/g, (colour) => darkColours[colour] ?? colour));
}

function draw(element) {
  delete element.dataset.drawn;
  const { data, layout } = coloured(document.getElementById(element.id + "_data").textContent);
  layout.template = coloured(JSON.stringify(style));
  if (narrow.matches && layout.showlegend !== false) {
    // the entries of the legend stand one below the other, and take no height from the panels
    layout.height += LEGEND_ROW_PX * data.filter((trace) => trace.showlegend !== false).length;
    const eye = layout.scene?.camera?.eye; // from further away a narrow window shows all of it
    for (const axis in eye) eye[axis] *= 1.5;
  }
  if (touch.matches) layout.dragmode = false; // a finger on a figure scrolls the page
  element.style.height = layout.height + "px";
  return Plotly.react(element, data, layout, {
    responsive: true,
    displaylogo: false,
    displayModeBar: true,
    modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "zoomIn2d", "zoomOut2d",
      "autoScale2d", "orbitRotation", "tableRotation", "resetCameraLastSave3d"],
    toImageButtonOptions: { format: "png", scale: 2, filename: element.id },
  }).then(() => { element.dataset.drawn = dark.matches ? "dark" : "light"; });
}

// The x axis of a linked figure was zoomed: show the same range in the others.
let following = false;
function follow(element, changed) {
  const moved = Object.keys(changed).some((key) => key.startsWith("xaxis"));
  if (following || !moved) return;
  following = true;
  const range = [...element.layout.xaxis.range];
  const others = linked.filter((other) => other !== element);
  Promise.all(others.map((other) => Plotly.relayout(other, { "xaxis.range": [...range] })))
    .finally(() => { following = false; });
}

// On paper a figure is as wide as the text, in light colours.
const PAPER_PX = 700;
function fit(width) {
  for (const element of figures) Plotly.relayout(element, { width, autosize: !width });
}
addEventListener("beforeprint", () => fit(PAPER_PX));
addEventListener("afterprint", () => fit(null));

const figures = [...document.querySelectorAll(".figure")];
const linked = figures.filter((element) => element.classList.contains("linked"));
figures.forEach((element) => draw(element).then(() => {
  if (linked.includes(element)) {
    element.on("plotly_relayout", (changed) => follow(element, changed));
  }
}));
for (const query of [dark, narrow]) {
  query.addEventListener("change", () => figures.forEach(draw));
}
