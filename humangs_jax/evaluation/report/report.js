"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const PICTURES = ["truth", "ours", "error"];
const by = (id) => document.getElementById(id);

/** An element with attributes (text, className, ...) and children. */
function element(tag, attributes = {}, ...children) {
  const made = Object.assign(document.createElement(tag), attributes);
  made.append(...children);
  return made;
}

const known = Object.keys(data.means).filter((name) => data.means[name] !== null);
const digits = (name, value) => (value === null ? "-" : value.toFixed(data.columns[name].digits));

// ---- head ------------------------------------------------------------------------------------------------------------

const about = data.about;
const inputs = about.inputs.length ? `, ${about.inputs.join(" or ")} input photos` : "";
by("title").textContent = document.title;
by("about").textContent = `${about.source}: ${about.counts}${inputs}`;
for (const name of known) {
  const mean = data.means[name];
  const interval = mean.low === null ? "" : `${digits(name, mean.low)} to ${digits(name, mean.high)}`;
  by("means").append(element("div", {},
    element("span", { textContent: data.columns[name].heading }),
    element("b", { textContent: digits(name, mean.mean) }),
    element("span", { textContent: interval })));
}
by("notes").append(...data.notes.map((note) => element("li", { textContent: note })));
by("largest").textContent = data.largest_error;

// ---- tables that sort ------------------------------------------------------------------------------------------------

/** Fills a table; columns: {key, heading, text, value(row), cell(row)}; a column without a value does not sort. */
function sortable(table, columns, rows, key, ascending) {
  const body = element("tbody");
  const order = { key, ascending };
  const heads = columns.map((column) => {
    const head = element("th", { className: column.value ? (column.text ? "text" : "") : "picture", scope: "col" });
    if (!column.value) {
      head.textContent = column.heading;
      return head;
    }
    const button = element("button", { type: "button", textContent: column.heading });
    button.addEventListener("click", () => {
      order.ascending = order.key === column.key ? !order.ascending : column.better !== "down";
      order.key = column.key;
      fill();
    });
    head.dataset.key = column.key;
    head.append(button);
    return head;
  });

  /** Missing numbers come last in both directions. */
  function compare(a, b) {
    const column = columns.find((each) => each.key === order.key);
    const [x, y] = [column.value(a), column.value(b)];
    if (x === null || y === null) return (x === null) - (y === null);
    const sign = typeof x === "string" ? x.localeCompare(y, undefined, { numeric: true }) : x - y;
    return order.ascending ? sign : -sign;
  }

  function fill() {
    for (const head of heads) {
      if (head.dataset.key === order.key) head.ariaSort = order.ascending ? "ascending" : "descending";
      else head.removeAttribute("aria-sort");
    }
    const sorted = rows().sort(compare);
    body.replaceChildren(...sorted.map((row) => element("tr", {}, ...columns.map((column) => column.cell(row)))));
    return sorted;
  }

  table.append(element("thead", {}, element("tr", {}, ...heads)), body);
  fill();
  return fill;
}

const textColumn = (key, heading, value) => ({
  key, heading, text: true, value, cell: (row) => element("td", { className: "text", textContent: value(row) }),
});
const scoreColumn = (name, scores) => ({
  key: name, heading: data.columns[name].heading, better: data.columns[name].better, value: (row) => scores(row)[name],
  cell: (row) => element("td", { className: scores(row)[name] === null ? "none" : "",
    textContent: digits(name, scores(row)[name]) }),
});

const people = Object.entries(data.people).map(([name, scores]) => ({ name, scores }));
sortable(by("people"), [textColumn("person", "person", (row) => row.name),
  ...known.map((name) => scoreColumn(name, (row) => row.scores))], () => [...people], "psnr", true);

// ---- images ----------------------------------------------------------------------------------------------------------

const images = data.images.map((image, index) => ({ ...image, shot: data.shots[index] || null }));
const chosen = by("person");
chosen.append(element("option", { value: "", textContent: `all ${people.length}` }),
  ...people.map(({ name }) => element("option", { value: name, textContent: name })));

function picture(row, name) {
  const cell = element("td", { className: "picture" });
  if (row.shot) {
    const image = element("img", { src: row.shot[name], alt: `${name} of ${row.person} ${row.view}`, loading: "lazy" });
    image.addEventListener("click", () => enlarge(row));
    cell.append(image);
  }
  return cell;
}

function inputCell(row) {
  const photos = row.shot ? data.inputs[row.person] || [] : [];
  const shown = photos.map((src, i) => element("img", { src, alt: `input ${i + 1} of ${row.person}`, loading: "lazy" }));
  return element("td", { className: "picture inputs" }, element("div", {}, ...shown));
}

const fillImages = sortable(by("images"), [
  ...(Object.keys(data.inputs).length ? [{ key: "inputs", heading: "inputs", cell: inputCell }] : []),
  ...PICTURES.map((name) => ({ key: name, heading: name, cell: (row) => picture(row, name) })),
  textColumn("person", "person", (row) => row.person),
  { ...textColumn("frame", "frame", (row) => row.frame) },
  textColumn("view", "view", (row) => row.view),
  ...known.map((name) => scoreColumn(name, (row) => row.scores)),
], () => images.filter((row) => !chosen.value || row.person === chosen.value), "psnr", true);

function showImages() {
  const listed = fillImages();
  const pictured = listed.filter((row) => row.shot).length;
  const rest = pictured < listed.length ? `; the ${pictured} worst of them with images` : "";
  by("shown").textContent = `${listed.length} images${rest}`;
}
chosen.addEventListener("change", showImages);
showImages();

// ---- one image, large ------------------------------------------------------------------------------------------------

const large = by("large");
function enlarge(row) {
  large.querySelector("figure").replaceChildren(...PICTURES.map((name) => element("img", { src: row.shot[name], alt: name })));
  large.querySelector("p").textContent = `${row.person}, frame ${row.frame}, ${row.view}: truth, ours, error; PSNR ${
    digits("psnr", row.scores.psnr)}`;
  large.hidden = false;
}
large.addEventListener("click", () => { large.hidden = true; });
document.addEventListener("keydown", (event) => { if (event.key === "Escape") large.hidden = true; });

window.humangs = { ready: Promise.resolve() };
