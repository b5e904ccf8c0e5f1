// A restarted server, and the session of the page that was open meanwhile.

// Return {line, restores, offers} for a restarted server: one line for the user ("" for none), whether the page gives its
// session back, and whether it only offers to. before: {welcome, session, ran, left} of the lost connection; ran: whether an
// insertion or retraction ran; left: whether on a rig. Another initial scenario or rig was chosen on purpose; what another page has begun stays.
export function afterRestart(before, welcome, session) {
  const left = before.left ? " The needle may still be in the tissue: Retract withdraws it along its path." : "";
  const over = before.ran ? ` No insertion is resumed.${left}` : "";
  if (isSame(before.session, session)) return { line: over && `The server was restarted.${over}` };
  if (session.revision > 1) return { offers: true, line: `The server was restarted, and another page has changed its scenario.${over}` };
  if (welcome.initial !== before.welcome.initial) return { offers: true, line: `The server was restarted with ${welcome.rig === before.welcome.rig ? "another scenario" : "another rig"}: ${session.name} is kept.${over}` };
  return { restores: true, line: `The server was restarted, and has this page's scenario again.${over}` };
}

// The request that gives a session back.
export const restoreOf = ({ name, values, seed, strategy, controller, targets, target }) => ({ type: "restore", name, values, seed, strategy, controller, targets, target });

function isSame(one, other) {
  const [mine, theirs] = [restoreOf(one), restoreOf(other)].map(({ values, ...rest }) => JSON.stringify([rest, Object.entries(values).sort()]));
  return mine === theirs;
}
