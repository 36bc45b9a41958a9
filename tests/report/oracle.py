"""Plain definitions, one message at a time, of what the page computes in columns."""

import math


def plain_messages(events):
    """Return a dictionary from (sender, receiver, number) to [sent, outcome, ended, age]."""
    found = {}
    for row in events.itertuples():
        if row.kind == "send":
            found[row.node, row.peer, row.message] = [row.t, "under way", math.inf, math.nan]
        elif row.kind == "lost":
            found[row.node, row.peer, row.message][1:3] = ["lost", row.t]
        elif row.kind in ("deliver", "late"):
            outcome = "delivered" if row.kind == "deliver" else "late"
            found[row.peer, row.node, row.message][1:] = [outcome, row.t, row.age]
    return found


def on_show(messages, t, persist):
    """Return the messages that the views show at t with their state, as a set."""
    shown = set()
    for key, (sent, outcome, ended, _) in messages.items():
        until = max(ended if outcome != "lost" else sent, sent + persist)
        if sent <= t and (t < until or t == sent):
            state = "under way" if outcome != "lost" and t < ended else outcome
            shown.add((*key, sent, state))
    return shown


def last_heard(messages, node, t):
    """Return, for each sender to a node, the time of sending of the newest message delivered by t
    (None without one), and how many were lost or late since.
    """
    found = {}
    for (sender, receiver, _), (sent, outcome, ended, _) in messages.items():
        if receiver == node and outcome == "delivered" and ended <= t:
            found[sender] = max(found.get(sender, -math.inf), sent)
    senders = {sender for sender, receiver, _ in messages if receiver == node}
    missing = dict.fromkeys(senders, 0)
    for (sender, receiver, _), (sent, outcome, _, _) in messages.items():
        if receiver == node and sent <= t and sent > found.get(sender, -math.inf):
            missing[sender] += outcome in ("lost", "late")
    return {sender: (found.get(sender), missing[sender]) for sender in senders}


def reachable(messages, node, t, seen=None):
    """Return for each node the latest time of which news can have reached ``node`` by t, by
    following every message backwards.
    """
    best = {node: t} if seen is None else seen
    for (sender, receiver, _), (sent, outcome, ended, _) in messages.items():
        heard = ended <= t if seen is None else ended < t
        if receiver != node or outcome != "delivered" or not heard:
            continue
        if sent > best.get(sender, -math.inf):
            best[sender] = sent
            reachable(messages, sender, sent, best)
    return best
