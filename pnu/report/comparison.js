// A page that holds its views: tabs of tables, the viewer, and links such as page.html#shape=duck&mode=errors.
"use strict";

const views = JSON.parse($("#views").textContent);
let gallery = null;

if (views.length) {
  try {
    gallery = new Gallery(JSON.parse($("#colors").textContent));
    Object.assign(gallery.pick, JSON.parse($("#pick").textContent));
    for (const [key, value] of new URLSearchParams(location.hash.slice(1))) {
      if (key === "item") gallery.pick.grid = false;
      if (key in gallery.pick) gallery.pick[key] = key === "grid" ? value === "true" : value;
    }
    if (!(gallery.pick.up in TURN)) gallery.pick.up = "y";
    gallery.open(views);
  } catch (error) {
    $("#viewer").textContent = `The 3D views need WebGL 2, which this browser does not offer (${error.message}).`;
  }
}

for (const tab of document.querySelectorAll("#tabs button")) {
  tab.onclick = () => {
    for (const other of document.querySelectorAll("#tabs button")) other.setAttribute("aria-pressed", String(other === tab));
    for (const section of document.querySelectorAll("section.kind")) section.hidden = section.dataset.kind !== tab.dataset.kind;
    if (gallery && views.some((view) => view.kind === tab.dataset.kind)) {
      gallery.pick.kind = tab.dataset.kind;
      gallery.refresh();
    }
  };
}
