"""Parts of a page in a browser that are wider than their box."""

TOO_WIDE = """() => {
  const boxes = [document.documentElement, ...document.querySelectorAll("main, aside, .status, .panel, [data-panel]")];
  const name = ({ tagName, className, dataset }) => [tagName, className, dataset.panel].filter(Boolean).join(" ");
  return boxes.filter(({ scrollWidth, clientWidth }) => scrollWidth > clientWidth).map(name);
}"""


def too_wide(page):
    """Return the parts that are wider than their box: document, columns (which scroll separately), panels."""
    return page.evaluate(TOO_WIDE)
