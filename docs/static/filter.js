/* On a page with an element `filter`: a field that hides the rows of tables that do not match.

A row matches if it contains every word of the text, or if the text is its message: ellipses in a
message stand for numbers and names. A table without rows, and a section without tables, is hidden. */

const plain = (text) => text.toLowerCase().replace(/\s+/g, " ").trim();

/* Whether the pieces of a message between its ellipses occur in a text, in order. */
function quotes(text, message) {
  const pieces = message.split("…").map((piece) => piece.trim()).filter((piece) => /\w/.test(piece));
  let at = 0;
  const inOrder = pieces.every((piece) => {
    const found = text.indexOf(piece, at);
    at = found + piece.length;
    return found >= 0;
  });
  return inOrder && pieces.join("").length > 12;
}

function filtered(rows, text) {
  const words = text.split(" ");
  for (const row of rows) {
    const all = plain(row.textContent);
    const message = plain(row.cells[0].textContent);
    row.hidden = !words.every((word) => all.includes(word)) && !quotes(text, message);
  }
}

function addFilter(place) {
  const main = place.closest("article") ?? document.body;
  const rows = [...main.querySelectorAll("tbody tr")];
  const field = document.createElement("input");
  Object.assign(field, { type: "search", className: "filter" });
  field.placeholder = "Filter: paste the message, or words of it";
  field.setAttribute("aria-label", field.placeholder);
  const count = document.createElement("p");
  count.setAttribute("role", "status");
  field.addEventListener("input", () => {
    const text = plain(field.value);
    filtered(rows, text);
    for (const table of main.querySelectorAll("table")) {
      table.hidden = ![...table.tBodies].some((body) => [...body.rows].some((row) => !row.hidden));
    }
    const shown = rows.filter((row) => !row.hidden).length;
    for (const section of main.querySelectorAll("section section")) {
      section.hidden = text !== "" && !section.querySelector("tbody tr:not([hidden])");
    }
    count.textContent = text && `${shown} of ${rows.length} rows`;
  });
  place.append(field, count);
}

document.addEventListener("DOMContentLoaded", () => {
  const place = document.getElementById("filter");
  if (place) addFilter(place);
});
