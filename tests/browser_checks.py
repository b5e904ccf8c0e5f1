"""Steps and checks of a page in a browser: buttons, pixels that a part adds to drawings, parts wider than their box."""

from fake_page import until

PAINTED = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
FLAT = ("[data-panel=section] canvas", "[data-panel=axial] canvas")
BAR = "[data-panel=actions]"
FOCUSED = "document.activeElement.textContent"

# Antialiased and translucent parts have few pixels of their very tone; all of theirs are between what was there and it.
BLENDS = """
const { color } = await import("/static/theme.js");
const toneOf = (name) => color(name).match(/[0-9]+/g).slice(0, 3).map(Number);
function composed(canvas) {
  const copy = new OffscreenCanvas(canvas.width, canvas.height);
  const pen = copy.getContext("2d");
  pen.fillStyle = color("--stage");
  pen.fillRect(0, 0, copy.width, copy.height);
  pen.drawImage(canvas, 0, 0);
  return pen.getImageData(0, 0, copy.width, copy.height).data;
}
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
// Share from 0 to 1 of a pixel's way to a tone, or 0 where it has changed to something else.
function shareOf(before, after, at, tone) {
  const change = [0, 1, 2].map((part) => after[at + part] - before[at + part]);
  const whole = [0, 1, 2].map((part) => tone[part] - before[at + part]);
  const size = dot(change, change);
  const along = dot(change, whole);
  if (size < 100 || along < 0.97 * Math.sqrt(size * dot(whole, whole))) return 0;
  const share = along / dot(whole, whole);
  return share > 1.1 ? 0 : share;
}
function blended(before, after, tone) {
  let count = 0;
  for (let at = 0; at < after.length; at += 4) if (shareOf(before, after, at, tone)) count++;
  return count;
}
"""

_KEEP = f"""async (selectors) => {{
  {BLENDS}
  window.kept = selectors.map((selector) => composed(document.querySelector(selector)));
}}"""
_ADDED = f"""async ([selectors, tone]) => {{
  {BLENDS}
  const now = selectors.map((selector) => composed(document.querySelector(selector)));
  return now.map((after, at) => blended(window.kept[at], after, toneOf(tone)));
}}"""


def show(page, panel):
    """Show a view of the scene, or a tab; other panels are always in view."""
    key = {"space": "view scene", "section": "view scene"}.get(panel, "view tab")
    page.evaluate("([key, panel]) => flexneedle.store.set(key, panel)", [key, panel])
    page.wait_for_selector(f"section.{panel}:not([hidden])", state="attached")


def click_button(page, text, panel=BAR):
    """Click a button of the action bar, or of another panel, by its whole name."""
    page.locator(panel).get_by_role("button", name=text, exact=True).click()


def painted(page):
    """Wait until two paints have followed."""
    page.evaluate(PAINTED)


def arrived(page):
    """Wait until all news from the server is received and painted: an answer follows it."""
    page.evaluate("flexneedle.link.ask({ type: 'ping' })")
    painted(page)


def added(page, server, tone, *news, canvases=FLAT):
    """Return the number of pixels in each canvas that news from the server blends with a tone."""
    page.evaluate(_KEEP, list(canvases))
    server.send(*news)
    arrived(page)
    return page.evaluate(_ADDED, [list(canvases), tone])


_ALL_PANELS = """flexneedle.store.get('connection') === 'open' &&
  document.querySelectorAll('[data-panel]:empty').length === (flexneedle.store.get('view notice') ? 1 : 0)"""
"""The view in space stays empty without WebGL, which a notice reports."""


def loaded(page):
    """Wait until a page has all its panels, and has received and painted all news from the server."""
    page.wait_for_selector("[data-panel=status] .connection")
    until(page, _ALL_PANELS)
    arrived(page)


_TOO_WIDE = """() => {
  const boxes = [document.documentElement, ...document.querySelectorAll("main, aside, .status, .panel, [data-panel]")];
  const name = ({ tagName, className, dataset }) => [tagName, className, dataset.panel].filter(Boolean).join(" ");
  return boxes.filter(({ scrollWidth, clientWidth }) => scrollWidth > clientWidth).map(name);
}"""


def too_wide(page):
    """Return the parts that are wider than their box: document, columns (which scroll separately), panels."""
    return page.evaluate(_TOO_WIDE)
