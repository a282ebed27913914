// The head of a table sorts it by its column, numbers by their value; a second time in the other direction.
function sort(head) {
  const column = head.cellIndex, down = head.getAttribute("aria-sort") === "ascending";
  const body = head.closest("table").tBodies[0];
  for (const each of head.parentElement.cells) each.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const text = (row) => row.cells[column].textContent;
  const order = (a, b) => text(a).localeCompare(text(b), "en", { numeric: true }) * (down ? -1 : 1);
  body.append(...[...body.rows].sort(order));
}
// A link of the overview to the address that the page already has changes no address, but is to lead there.
document.addEventListener("click", (event) => {
  const link = event.target.closest("#overview a");
  if (link?.hash !== location.hash || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  window.dispatchEvent(new HashChangeEvent("hashchange"));
});
document.addEventListener("click", (event) => {
  const head = event.target.closest(".sort")?.parentElement;
  if (head) sort(head);
});
