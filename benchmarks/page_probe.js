// Runs before the scripts of the page: WebGL draws nothing, and window.probe has what happened when, in ms of
// performance.now(). An event's time is that of the input, before the browser gave it to the page.

(() => {
  const DRAWS = ["drawArrays", "drawElements", "drawRangeElements", "drawArraysInstanced", "drawElementsInstanced"];
  const HEARD = /^\{"type":"(session|estimate|plan|done|refused)"/;
  const frame = window.requestAnimationFrame.bind(window);
  const probe = (window.probe = { draws: 0, first: null });
  // frames: times of animation frames; paints: ms of script before each that drew; clicks: ms until each was handled and
  // painted; answered: ms until the server's answer to one was painted; moves, releases: times of the dragging
  // pointer; edits: {time, request, revision} (null: not answered, -1: refused); estimates, plans: {revision, time} of
  // their paint.
  probe.reset = () => Object.assign(probe, { frames: [], paints: [], clicks: [], answered: [], moves: [], releases: [], edits: [], estimates: [], plans: [], refused: [] });
  probe.reset();

  for (const name of DRAWS) {
    WebGL2RenderingContext.prototype[name] = () => {
      probe.draws += 1;
    };
  }

  // Messages of a channel come after the paint.
  const [channel, painted] = [new MessageChannel(), []];
  channel.port1.onmessage = () => painted.shift()();
  function afterPaint(call) {
    frame(() => {
      painted.push(call);
      channel.port2.postMessage(null);
    });
  }

  // Script before a paint: that of messages and timers since the paint before, and that of its animation frame.
  let [before, between, inFrame, drew] = [0, 0, 0, false];
  function timed(call) {
    const begun = performance.now();
    try {
      call();
    } finally {
      between += performance.now() - begun;
    }
  }
  const later = window.setTimeout.bind(window);
  window.setTimeout = (callback, delay) => later(() => timed(callback), delay);
  window.requestAnimationFrame = (callback) =>
    frame((now) => {
      const begun = performance.now();
      try {
        callback(now);
      } finally {
        inFrame += performance.now() - begun;
        drew = true;
      }
    });
  function tick(now) {
    frame(tick); // so that it is the first of the next frame, too
    if (drew) probe.paints.push(before + inFrame);
    [before, between, inFrame, drew] = [between + (drew ? 0 : before), 0, 0, false];
    probe.frames.push(now);
    if (probe.first === null && pictured()) probe.first = performance.now();
  }
  frame(tick);

  // Whether the frame before has shown the scene with its needle.
  function pictured() {
    const legend = document.querySelectorAll("[data-panel=space] .legend li");
    return probe.draws > 0 && [...legend].some(({ textContent }) => textContent === "needle");
  }

  // Where the target is in the section, and where it is to be: at a depth (mm), off by a share of its present depth.
  probe.places = async (depth, share) => {
    const [{ boxOf }, { lateral, mappingOf, planeOf }] = await Promise.all([import("/static/box.js"), import("/static/flat/plane.js")]);
    const scene = window.flexneedle.store.get("scene");
    const plane = planeOf(document.querySelector("[data-panel=section] [aria-pressed=true]").dataset.plane, scene, scene.target);
    const stage = document.querySelector("[data-panel=section] .stage");
    const { left, top, width, height } = stage.getBoundingClientRect();
    const map = mappingOf(boxOf(scene, scene.target), width - 2 * stage.clientLeft, height - 2 * stage.clientTop, 1);
    const place = (x, u) => [left + stage.clientLeft + map.toX(x), top + stage.clientTop + map.toY(u)];
    return [place(scene.target[0], lateral(plane, ...scene.target)), place(depth, share * depth)];
  };

  let [clicked, revision] = [null, null];
  const asked = new Map(); // by number: time of the click
  window.addEventListener("click", ({ timeStamp }) => {
    clicked = timeStamp;
    later(() => { clicked = null; });
    afterPaint(() => probe.clicks.push(performance.now() - timeStamp));
  }, true);
  window.addEventListener("pointermove", ({ timeStamp, buttons }) => {
    if (buttons) probe.moves.push(timeStamp);
  }, true);
  window.addEventListener("pointerup", ({ timeStamp }) => probe.releases.push(timeStamp), true);

  function sent({ type, request }) {
    if (type === "edit") probe.edits.push({ time: performance.now(), request, revision: null });
    if (type === "steer" && clicked !== null) asked.set(request, clicked);
  }

  function heard(message) {
    if (message.type === "session") revision = message.revision;
    else if (message.type === "done" || message.type === "refused") answered(message);
    else {
      const list = message.type === "plan" ? probe.plans : probe.estimates;
      afterPaint(() => list.push({ revision: message.revision, time: performance.now() }));
    }
  }

  function answered({ type, request, reason }) {
    if (type === "refused") probe.refused.push(reason);
    for (const edit of probe.edits) if (edit.request === request) edit.revision = type === "done" ? revision : -1;
    const time = asked.get(request);
    if (asked.delete(request)) afterPaint(() => probe.answered.push(performance.now() - time));
  }

  const Socket = window.WebSocket;
  window.WebSocket = class extends Socket {
    set onmessage(listener) {
      super.onmessage = (event) => {
        timed(() => listener(event));
        if (typeof event.data === "string" && HEARD.test(event.data)) heard(JSON.parse(event.data));
      };
    }

    send(text) {
      sent(JSON.parse(text));
      super.send(text);
    }
  };
})();
