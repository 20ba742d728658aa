// The page of `pnu app`: a scan goes to the server of this machine, which says what it found and made.
"use strict";

const settings = JSON.parse($("#settings").textContent);
const form = $("#form");
const STAGES = {
  starting: "starting", reading: "reading the file", looking: "looking at it", normals: "finding normals", seeds: "placing new points",
  spheres: "fitting spheres", shortlist: "choosing points", projection: "moving points onto the surface", thinning: "spreading points evenly",
  "even spacing": "spreading points evenly", refinement: "refining", Poisson: "making the surface", holes: "filling holes", picture: "drawing",
};
let token = sessionStorage.getItem("token");
let state = null, shown = null, gallery = null, uploading = null, proposed = null, timer = 0;

try { gallery = new Gallery(settings.colors); } catch (error) { $("#hint").textContent = `The 3D view needs WebGL 2 (${error.message}).`; }

async function ask(path, method = "GET", body = undefined) {
  const answer = await fetch(`/s/${token}/${path}`, { method, body: body && JSON.stringify(body) });
  const value = await answer.json();
  if (answer.status === 404) sessionStorage.removeItem("token");
  if (!answer.ok) throw new Error(value.error);
  return value;
}

async function begin() {
  if (token) { try { state = await ask("state"); return show(); } catch { token = null; } }
  token = (await (await fetch("/sessions", { method: "POST" })).json()).token;
  sessionStorage.setItem("token", token);
  state = await ask("state");
  show();
}

async function poll() {
  clearTimeout(timer);
  try { state = await ask("state"); show(); } catch (error) { say(error.message || "pnu app does not answer; is it running?"); }
  timer = setTimeout(poll, busy() ? 400 : 20000); // the slow ones tell that somebody is still here
}

const busy = () => state && (state.phase === "looking" || state.phase === "working");
const number = (count) => count.toLocaleString("en-US").replaceAll(",", "\u202f");

function say(text) {
  $("#error").textContent = text || "";
  $("#error").hidden = !text;
}

function list(id, texts, kinds = []) {
  $(id).replaceChildren(...texts.map((text, i) => Object.assign(document.createElement("li"), { textContent: text, className: kinds[i] || "" })));
}

function time(seconds) {
  if (seconds === null || seconds === undefined) return "";
  const whole = Math.max(1, Math.round(seconds));
  return whole < 60 ? `about ${whole} s left` : `about ${Math.round(whole / 60)} min left`;
}

function show() {
  const { look, result, progress } = state;
  document.body.dataset.phase = state.phase;
  say(state.stopped ? "" : state.error);
  $("#drop").classList.toggle("small", !!state.scan && !state.error);
  $("#drop b").textContent = state.scan && !state.error ? "Drop another scan" : "Drop a scan here";
  $("#over").hidden = !state.scan;
  $("#about").hidden = !look;
  $("#hint").hidden = !!(look || result);
  $("#help").hidden = $("#controls").hidden = !(look || result);
  form.hidden = !look;
  $("#fields").disabled = busy();
  $("#go").hidden = busy();
  $("#progress").hidden = !busy();
  $("#made").hidden = state.phase !== "done";
  if (look) {
    $("#name").textContent = state.scan;
    $("#size").textContent = `${number(look.points)} points, ${look.origin}${look.colors ? ", colored" : ""}`;
    list("#findings", look.findings.map((one) => one.text), look.findings.map((one) => one.kind));
    const notes = [...look.notes, ...(state.phase === "done" ? state.lines.map((line) => line.trim()) : [])];
    list("#notes", notes);
    $("#more").hidden = !notes.length;
    if (proposed !== look.number + state.scan) propose(look);
  }
  if (busy()) {
    const stage = progress ? progress.stage : "starting";
    $("#stage").textContent = STAGES[Object.keys(STAGES).find((name) => stage.startsWith(name))] || stage;
    $("#left").textContent = state.phase === "working" && progress ? time(progress.left) : "";
    $("#done").style.width = `${100 * (progress ? progress.fraction : 0)}%`;
    $("#stop").hidden = state.phase !== "working";
  }
  if (state.phase === "done") {
    const { made } = result;
    $("#counts").textContent = `${number(made.scan)} points read, ${number(made.stray)} taken out, ${number(made.dense)} made`
      + (made.faces ? `, surface of ${number(made.faces)} triangles.` : ".");
    $("#command").textContent = state.command.join("\n");
    downloads();
  }
  const latest = state.phase === "done" ? result : look;
  if (gallery && latest && shown !== latest.number + state.scan) {
    shown = latest.number + state.scan;
    Object.assign(gallery.pick, { grid: true, item: null, mode: state.phase === "done" ? "normals" : "found", form: "points" });
    gallery.open([{ ...latest.view, url: `/s/${token}/view/${latest.number}` }]);
  }
}

function propose(look) {
  proposed = look.number + state.scan;
  form.reset();
  form.ratio.value = look.proposal.ratio;
  form.spacing.value = look.proposal.spacing;
  form.holes.value = look.proposal.holes;
  if (gallery) gallery.pick.up = look.up;
  dependent();
}

function dependent() {
  form.holes.disabled = !form.fill.checked;
  form.ratio.hidden = form.amount.value !== "ratio";
  form.spacing.hidden = form.amount.value !== "spacing";
}

function downloads() {
  const names = { cloud: "dense cloud", mesh: "surface", removed: "taken out" };
  const key = JSON.stringify(state.files);
  if ($("#downloads").dataset.key === key) return;
  $("#downloads").dataset.key = key;
  const rows = Object.entries(state.files).map(([kind, files]) => {
    const row = document.createElement("div"), choice = document.createElement("select");
    choice.setAttribute("aria-label", `format of the ${names[kind]}`);
    choice.replaceChildren(...files.map((file) => new Option(file.slice(file.lastIndexOf(".") + 1), file)));
    row.dataset.kind = kind;
    row.append(names[kind], choice, download(() => choice.value));
    return row;
  });
  const page = document.createElement("div");
  page.className = "page";
  page.append("a page to send", download(() => state.page));
  $("#downloads").replaceChildren(...rows, page);
}

function download(name) {
  const button = Object.assign(document.createElement("button"), { type: "button", textContent: "download" });
  button.onclick = async () => {
    button.disabled = true;
    try {
      await ask(`ready/${encodeURIComponent(name())}`, "POST", {});
      Object.assign(document.createElement("a"), { href: `/s/${token}/file/${encodeURIComponent(name())}`, download: name() }).click();
    } catch (error) { say(error.message); }
    button.disabled = false;
  };
  return button;
}

function upload(file) {
  if (!file) return;
  if (file.size > settings.limit) { say(`${file.name}: has ${Math.ceil(file.size / 1e6)} MB, at most ${settings.limit / 1e6} MB are taken; limit_mb= raises it`); return; }
  if (uploading) uploading.abort();
  const request = uploading = new XMLHttpRequest();
  say("");
  form.hidden = $("#about").hidden = $("#made").hidden = true;
  $("#progress").hidden = false;
  $("#stop").hidden = true;
  $("#left").textContent = "";
  $("#stage").textContent = "taking the file";
  request.upload.onprogress = (event) => { $("#done").style.width = `${(100 * event.loaded) / event.total}%`; };
  request.onloadend = () => {
    if (uploading !== request) return;
    uploading = null;
    $("#progress").hidden = true;
    let error = request.status ? null : "the file could not be taken; is pnu app running?";
    if (request.status >= 400) error = JSON.parse(request.responseText).error;
    poll().then(() => { if (error) say(error); });
  };
  request.open("PUT", `/s/${token}/scan?name=${encodeURIComponent(file.name)}`);
  request.send(file);
}

form.onchange = dependent;
form.onsubmit = async (event) => {
  event.preventDefault();
  const [key, value] = form.sight.value.split("=");
  const wanted = {
    outliers: form.clean.checked ? "auto" : "keep", normals: form.normals.value, density: form.density.value,
    [form.amount.value]: form[form.amount.value].value, holes: form.fill.checked ? form.holes.value : null, surface: form.surface.checked,
    ...(key ? { [key]: value } : {}),
  };
  try { await ask("make", "POST", wanted); poll(); } catch (error) { say(error.message); }
};
$("#stop").onclick = async () => { await ask("stop", "POST", {}); poll(); };
$("#over").onclick = async () => { try { await ask("end", "POST", {}); } catch { /* it has ended */ } sessionStorage.removeItem("token"); location.reload(); };
$("#copy").onclick = () => navigator.clipboard.writeText($("#command").textContent);
$("#choose").onchange = (event) => { upload(event.target.files[0]); event.target.value = ""; };
$("#drop").onkeydown = (event) => { if (event.key === "Enter" || event.key === " ") $("#choose").click(); };
let inside = 0;
addEventListener("dragenter", (event) => { event.preventDefault(); inside += 1; document.body.classList.add("over"); });
addEventListener("dragleave", () => { inside -= 1; if (inside < 1) document.body.classList.remove("over"); });
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  inside = 0;
  document.body.classList.remove("over");
  upload(event.dataTransfer.files[0]);
});
begin().then(poll, () => say("pnu app does not answer; is it running?"));
