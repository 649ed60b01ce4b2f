"use strict";
// Controls of the report: shown codes and sets, quantity of a plot, light or dark.

// Return all models of the plots.
function models() {
  return Bokeh.documents.flatMap((doc) => [...doc.all_models]);
}

function tagged(test) {
  return models().filter((model) => model.tags.some(test));
}

// Rules, axes and titles follow the reader's colour scheme, since dark ones are invisible on a dark page.
function paint(dark) {
  const ink = dark ? "#e4e4e4" : "#222222";
  const look = (model, names) => {
    for (const name of names) if (name in model.properties) model[name] = ink;
  };
  for (const model of models()) {
    look(model, ["axis_label_text_color", "major_label_text_color", "axis_line_color"]);
    look(model, ["major_tick_line_color"]);
    if (model.type === "Title") model.text_color = ink;
  }
  for (const model of tagged((tag) => tag === "ink")) model.line_color = ink;
}

function showCode(code, shown) {
  for (const model of tagged((tag) => tag === `code:${code}`)) model.visible = shown;
}

function showSet(index, shown) {
  for (const element of document.querySelectorAll(`[data-set="${index}"]`)) element.hidden = !shown;
}

// Set properties before data, so that no mark is drawn on an axis that is about to change.
function choose(control, value) {
  const changes = [];
  for (const model of models()) {
    for (const tag of model.tags) {
      if (tag.control === control && value in tag.options) changes.push([model, tag.options[value]]);
    }
  }
  changes.sort((a, b) => ("data" in a[1]) - ("data" in b[1]));
  for (const [model, properties] of changes) model.setv(properties);
}

// A canvas has the width of the screen. Print pictures of the plots instead, in dark colours.
function takePictures() {
  paint(false);
  for (const view of Bokeh.index) {
    const host = document.querySelector(`[data-root-id="${view.model.id}"]`);
    const { canvas } = view.export("png");
    if (!host || !canvas.width) continue;
    const picture = new Image();
    picture.className = "print";
    picture.src = canvas.toDataURL();
    host.after(picture);
  }
}

function start() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  paint(dark.matches);
  dark.addEventListener("change", () => paint(dark.matches));
  addEventListener("beforeprint", takePictures);
  addEventListener("afterprint", () => {
    for (const picture of document.querySelectorAll("img.print")) picture.remove();
    paint(dark.matches);
  });
  for (const input of document.querySelectorAll("[data-controls]")) {
    const apply = () => {
      const kind = input.dataset.controls;
      if (kind === "code") showCode(input.value, input.checked);
      else if (kind === "set") showSet(input.value, input.checked);
      else choose(kind, input.value);
    };
    input.addEventListener("change", apply);
  }
  document.documentElement.dataset.ready = "yes";
}

(function wait() {
  if (globalThis.Bokeh?.documents.length) start();
  else setTimeout(wait, 20);
})();
