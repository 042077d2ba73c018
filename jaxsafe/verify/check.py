"""Check a certificate of `jaxsafe verify`: `python check.py proof.npz [other.npz]`.

This file needs NumPy alone and shares no code with the search. It checks that the proved boxes
fill the whole box, and follows the set of states from each of them with its own bounds. With a
second certificate it also checks that both are about the same loop. It prints one line, and exits
with 0 if the proof holds and with 1 if it does not.
"""

import json
import sys

import numpy as np

E = 2.0**-42  # bounds the relative rounding of sums of up to 1,000 terms in float64
SAME = ("programs", "plant", "unit", "steps", "property", "columns", "curved", "motion")
TURNS = {  # the points at which the derivative of a function is k
    "tanh": lambda k: [t := np.arctanh(np.sqrt(np.clip(1 - k, 0, 1))), -t],
    "exp": lambda k: [np.log(k)],
    "log": lambda k: [1 / k],
    "sqrt": lambda k: [0.25 / k**2],
    "square": lambda k: [0.5 * k],
    "abs": lambda k: [0 * k],
    "reciprocal": lambda k: [t := 1 / np.sqrt(-k), -t],
    "inverse": lambda k: [t := 1 / np.sqrt(-k), -t],
    "atan": lambda k: [t := np.sqrt(np.maximum(1 / k - 1, 0)), -t],
}
CALLS = {
    "reciprocal": lambda x: 1 / x,
    "inverse": lambda x: 1 / x,
    "max": np.maximum,
    "min": np.minimum,
    "atan": np.arctan,
}
EXACT = ("affine", "max", "min", "abs", "select", "floor", "sin", "cos", "atan")
UNITS = dict.fromkeys(EXACT, 0) | dict.fromkeys(("tanh", "exp", "log"), 16)
ABSOLUTE = {"sin": 4, "cos": 4, "atan": 4}


def need(fact, text):
    """Refuse the certificate unless a fact holds."""
    if not np.all(fact):
        sys.exit(f"refused: {text}")


def up(x):
    """Round upwards, past the rounding of a sum."""
    return np.nextafter(x * (1 + E), np.inf)


def times(a, x):
    """Multiply a batch of matrices and a batch of vectors."""
    return (a @ x[..., None])[..., 0]


def fill(low, high, first, last):
    """Check that boxes fill the box from first to last: cut it until one box fills each part."""
    flat = first == last
    meets = np.where(flat, (low <= first) & (high >= last), (low < last) & (high > first)).all(1)
    low, high = np.maximum(low[meets], first), np.minimum(high[meets], last)
    if np.any(np.all((low == first) & (high == last), axis=1)):
        return
    for axis in np.argsort(first - last):
        cuts = np.unique(np.concatenate([low[:, axis], high[:, axis]]))
        cuts = cuts[(cuts > first[axis]) & (cuts < last[axis])]
        if len(cuts):
            left, right = last.copy(), first.copy()
            left[axis] = right[axis] = cuts[len(cuts) // 2]
            fill(low, high, first, left)
            return fill(low, high, right, last)
    need(False, f"no box covers the starts from {first} to {last}")


def ends(f, sets):
    """Return the interval of a form over sets of states.

    A form (slope, centre, radius, low, high) says of a vector v that |v - slope y - centre| <=
    radius and low <= v <= high. A set (centre, wide, thin, reach) holds the states y = centre +
    wide e + f with |e| <= 1 and |f| <= thin, and reach bounds |y|.
    """
    centre, wide, thin, reach = sets
    half = np.abs(f[0] @ wide).sum(-1) + times(np.abs(f[0]), thin) + f[2]
    half = up(half) + 4 * E * (times(np.abs(f[0]), reach) + np.abs(f[1]))
    middle = times(f[0], centre) + f[1]
    return np.maximum(middle - half, f[3]), np.minimum(middle + half, f[4])


def terms(f, sets):
    """Return a bound on the terms of a form that may cancel, over sets of states."""
    return up(times(np.abs(f[0]), sets[3]) + np.abs(f[1]))


def size(f, sets):
    """Return a bound on the absolute values of a form over sets of states."""
    return np.minimum(up(terms(f, sets) + f[2]), np.maximum(np.abs(f[3]), np.abs(f[4])))


def linearise(kind, constants, x, sets):
    """Return an operation as coefficients of its inputs, offset, noise, least and largest value."""
    if kind == "affine":
        (low, noise), *matrices = constants
        high, far = low, np.abs(low)
        for (m, radius), f in zip(matrices, x, strict=True):
            noise = noise + size(f, sets) @ radius.T
            if m.size > 1024:  # intervals are wider than forms here and not worth their time
                low, high = low - np.inf, high + np.inf
                continue
            a, b = (np.where(m != 0, m * v[:, None], 0) for v in f[3:])
            low, high = low + np.minimum(a, b).sum(-1), high + np.maximum(a, b).sum(-1)
            far = far + np.maximum(np.abs(a), np.abs(b)).sum(-1)
        slack = up(noise) + np.where(np.isfinite(far), E * far, 0)
        return [m for m, _ in matrices], constants[0][0], up(noise), low - slack, high + slack
    spans = [ends(f, sets) for f in x]
    if kind == "norm":
        return norm(x[0], *spans[0], sets)
    rule = {"mul": mul, "select": select, "floor": floor}.get(kind, curve)
    return settle(*rule(kind, constants, x, spans, sets))


def settle(local, offset, noise, low, high):
    """Drop the coefficients where the noise is not finite, and take the interval as the noise.

    An infinite interval may become known again, and one that is not a number stays unknown.
    """
    known, finite = np.isfinite(noise), np.isfinite(low) & np.isfinite(high)
    least, most = (np.where(finite, v, 0) for v in (low, high))
    rest = np.where(finite, up(most - least) / 2 * (1 + E), np.inf)
    rest = np.where(np.isnan(low) | np.isnan(high), np.nan, rest)
    local = [np.where(known, a, 0) for a in local]
    offset = np.where(known, offset, (least + most) / 2)
    return local, offset, np.where(known, noise, rest), low, high


def mul(kind, constants, x, spans, sets):
    """Multiply: linearise at the middles of both intervals."""
    (a, b), (p, q) = [(0.5 * (c + d), np.maximum(d - c, 0)) for c, d in spans]
    pairs = [(c, d) for c in spans[0] for d in spans[1]]
    corners = np.stack(
        [np.where((c == 0) & np.isinf(d) | (d == 0) & np.isinf(c), 0, c * d) for c, d in pairs]
    )
    return [p, a], -a * p, up(b * q) / 4 * (1 + E), corners.min(0), corners.max(0)


def select(kind, constants, x, spans, sets):
    """Choose the second input where the first is positive, and else the third."""
    (low, high), (a, b), (p, q) = spans
    yes, no = low > 0, high <= 0
    f = [u - v for u, v in zip(x[1][:2], x[2][:2], strict=True)]
    apart = ends((*f, x[1][2] + x[2][2], -np.inf, np.inf), sets)
    slack = 4 * E * (terms(x[1], sets) + terms(x[2], sets))
    half = np.maximum(np.abs(apart[0]), np.abs(apart[1])) + slack
    half = up(np.minimum(half, np.maximum(b - p, q - a))) / 2
    share = np.where(yes, 1.0, np.where(no, 0.0, 0.5))
    least = np.where(yes, a, np.where(no, p, np.minimum(a, p)))
    most = np.where(yes, b, np.where(no, q, np.maximum(b, q)))
    return [0 * share, share, 1 - share], 0 * share, np.where(yes | no, 0, half), least, most


def floor(kind, constants, x, spans, sets):
    """Round downwards."""
    low, high = (np.floor(v) for v in spans[0])
    one = low == high
    local = [np.where(one, 0.0, 1.0)]
    return local, np.where(one, low, -0.5), np.where(one, 0, 0.5), low, high


def crossings(angle, low, high):
    """Return the points of an interval whose cosine is that of an angle, or its ends."""
    turn = 2 * np.pi
    near = [a + turn * np.round(((low + high) / 2 - a) / turn) for a in (angle, -angle)]
    return [np.clip(a + shift, low, high) for a in near for shift in (-turn, 0, turn)]


def curve(kind, constants, x, spans, sets):
    """Bound a function of one number by two parallel lines."""
    low, high = spans[0]
    far = np.maximum(np.abs(low), np.abs(high))
    fixed = [value for value, _ in constants]
    call = CALLS.get(kind) or getattr(np, kind)
    wide = high - low > 1e-9 * (np.abs(low) + np.abs(high))
    waves = {"sin": 0, "cos": np.pi / 2}
    if kind in waves:
        wide &= high - low < 2 * np.pi
    k = np.where(wide, (call(high, *fixed) - call(low, *fixed)) / np.where(wide, high - low, 1), 0)
    extremes = [low, high]
    if kind in waves:
        shift = waves[kind]
        inner, tops = (
            [np.clip(t - shift, low, high) for t in crossings(angle, low + shift, high + shift)]
            for angle in (np.arccos(np.clip(k, -1, 1)), np.pi / 2 + 0 * k)
        )
        extremes += tops
    else:
        inner = [np.clip(t, low, high) for t in fixed or TURNS[kind](k)]
    points = np.stack([low, high, *inner])
    values = call(np.stack([*points, *extremes[2:]]), *fixed)
    gaps = values[: len(points)] - k * points
    radius = sum(r for _, r in constants)
    size = np.abs(values).max(0) + np.abs(k) * far + (kind in waves)
    rough = 4 * E * size + radius
    middle, noise = 0.5 * (gaps.max(0) + gaps.min(0)), up(0.5 * (gaps.max(0) - gaps.min(0))) + rough
    least, most = values.min(0), values.max(0)
    slack = [np.where(np.isfinite(size), rough, 4 * E * np.abs(v) + radius) for v in (least, most)]
    least, most = least - slack[0], most + slack[1]
    if kind in waves:
        whole = high - low >= 2 * np.pi
        middle, noise = np.where(whole, 0, middle), np.where(whole, 1, noise)
        least, most = np.where(whole, -1, least), np.where(whole, 1, most)
    fits = {
        "log": low > 0,
        "sqrt": low >= 0,
        "reciprocal": low * high > 0,
        "inverse": low * high > 0,
        **dict.fromkeys(waves, far <= 1e4),
    }.get(kind, True)
    worst = np.inf if kind == "inverse" else np.nan
    noise = np.where(fits, noise, np.nan)
    return [k], middle, noise, np.where(fits, least, -worst), np.where(fits, most, worst)


def norm(f, low, high, sets):
    """Bound a Euclidean norm by its tangent."""
    far = np.maximum(np.abs(low), np.abs(high))
    middle = 0.5 * (low + high)
    length = np.sqrt((middle**2).sum(-1, keepdims=True))
    w = np.divide(middle, length, out=np.zeros_like(middle), where=length > 0)
    split = np.concatenate([w[:, None], np.eye(w.shape[1]) - w[:, :, None] * w[:, None]], 1)
    radius = times(np.abs(split), f[2]) + 4 * E * terms(f, sets).sum(-1)[:, None]
    a, b = ends((split @ f[0], times(split, f[1]), radius, -np.inf, np.inf), sets)
    far, near = (np.sqrt((v**2).sum(-1)) for v in (far, np.maximum(np.maximum(low, -high), 0)))
    rest = (np.maximum(np.abs(a), np.abs(b))[:, 1:] ** 2).sum(-1)
    gap = np.divide(rest / 2, a[:, 0], out=np.full_like(rest, np.inf), where=a[:, 0] > 0)
    gap, far = (up(np.minimum(gap, far - a[:, 0])) + 4 * E * far)[:, None], far[:, None]
    return [w], gap / 2, gap / 2 + 4 * E * far, near[:, None] * (1 - 4 * E), up(up(far))


def act(kind, a, v):
    """Return what an input adds to the result of an operation with coefficients a.

    v holds the slopes of the input, or other columns.
    """
    if kind == "affine":
        return a @ v
    a = a[..., None]
    product = np.where(a == 0, 0, a * v)
    return product.sum(1, keepdims=True) if kind == "norm" else product


def bound(program, unit, sets, low, high):
    """Return slope, centre, radius, least and largest value of each output of a program."""
    zero = np.zeros_like(low)
    forms = {program["input"]: (np.eye(low.shape[1]) + zero[..., None], zero, zero, low, high)}
    tape = []
    for kind, keys, key, constants in program["ops"]:
        x = [forms[k] for k in keys]
        local, offset, noise, bottom, top = linearise(kind, constants, x, sets)
        pairs = list(zip(local, x, strict=True))
        slope = np.sum([act(kind, a, f[0]) for a, f in pairs], 0)
        centre = np.sum([act(kind, a, f[1][..., None])[..., 0] for a, f in pairs], 0) + offset
        rest = [np.stack([terms(f, sets), f[2]], -1) for f in x]
        both = np.sum([act(kind, np.abs(a), v) for a, v in zip(local, rest, strict=True)], 0)
        fine = 4 * E * (both[..., 0] + np.abs(offset))
        units = (2.1 * x[0][0].shape[1] if kind == "norm" else UNITS.get(kind, 2.1)) * unit
        form = (slope, centre, both[..., 1] + noise, bottom, top)
        own = units * size(form, sets) if units else 0
        lost = ABSOLUTE.get(kind, 0) * unit + 2.0**-60
        noise = up(noise + fine + own) + lost
        low, high = (
            v + s * ((units + 4 * E) * np.abs(v) + lost) for v, s in ((bottom, -1), (top, 1))
        )
        forms[key] = (slope, centre, up(both[..., 1] + noise), low, high)
        tape.append((kind, keys, key, local, noise))
    out = forms[program["output"]]
    rows, radius = {program["output"]: np.eye(out[1].shape[1]) + 0 * out[1][..., None]}, 0
    for kind, keys, key, local, noise in reversed(tape):
        row = rows.pop(key)
        radius = radius + np.where(row == 0, 0, np.abs(row) * noise[:, None]).sum(-1)
        for k, a in zip(keys, local, strict=True):
            rows[k] = rows.get(k, 0) + (row @ a if kind == "affine" else row * a[:, None])
    return (*out[:2], np.minimum(up(radius) + 4 * E * out[2], out[2]), *ends(out, sets))


def reduced(wide, thin, order):
    """Put a parallelotope around all generators of sets but those whose box would be widest.

    Return the generators, and what rounding leaves open. Each row is freed of the rows above it.
    """
    total, count = wide.shape[1:]
    rows = np.concatenate([wide, thin], 2)
    squares, shear = (rows**2).sum(-1), np.eye(total) + np.zeros((len(wide), 1, 1))
    for i in range(total - 1):
        square, part = (rows[:, i] ** 2).sum(-1)[:, None], times(rows[:, i + 1 :], rows[:, i])
        part = np.divide(part, square, out=0 * part, where=square > 1e-20 * squares[:, i, None])
        rows[:, i + 1 :] -= part[..., None] * rows[:, i, None]
        shear[:, i + 1 :, i] = part
    rows = np.abs(rows)
    share = rows / np.maximum(rows.sum(-1, keepdims=True), 1e-300)
    cost = (share.max(1) - share.sum(1))[:, :count]
    best = np.argsort(cost, axis=1)[:, None, : (order - 1) * total]
    np.put_along_axis(rows, best, 0, 2)
    half = up(rows.sum(-1))
    fine = up(4 * E * times(np.abs(shear), half))
    kept = np.take_along_axis(wide, best, 2)
    return np.concatenate([kept, shear * half[:, None]], 2), fine[..., None] * np.eye(total)


def gap(plant, speed, far, near):
    """Return by how much h may fall inside a step below its values at both ends.

    This is the lemma of docs/verification.md. speed and far bound ||v|| and ||r|| at both ends, and
    near is at most ||r|| at one end.
    """
    n, dt, a = plant["mean_motion"], plant["dt"], plant["acceleration"]
    share = 1 - n * dt - 0.75 * (n * dt) ** 2
    need(share > 0, "a step is too long for the bound between its ends")
    v = (speed + dt / 2 * (a + 3 * n**2 * far)) / share
    jerk = 3 * n**2 * v + 2 * n * (first := a + 2 * n * v + 3 * n**2 * (far + dt / 2 * v))
    jerk = jerk + plant.get("turn_rate", 0) * a
    chord = np.maximum(near - dt * v, 1e-300)
    lag = np.minimum(2 * dt * v, (dt * v) ** 2 / 2 / chord)
    return 0.25 * (dt**2 / 2 * jerk + plant["slope"] * (dt**2 / 2 * first + lag)) * (1 + 1e-9)


def follow(head, low, high, claims):
    """Check the claims of some boxes, and bound h below along all episodes from them.

    Also return a lower bound of the last output after the last step.
    """
    d, m, size = head["dimension"], head["actions"], len(head["columns"])
    curved, begin, docks = head.get("curved"), head.get("motion", 0), head["property"] == "docks"
    total, linear = size + m, 0 if curved else size
    zeros = np.zeros((len(low), m))
    low, high = (np.concatenate([v, zeros], axis=1) for v in (low, high))
    centre = 0.5 * (low + high)
    wide = up(np.maximum(high - centre, centre - low))[:, :, None] * np.eye(total)
    thin, worst, before = 0 * wide, np.full(len(low), np.inf), None
    deep, order, every = worst, head.get("order", 0), head.get("every", 1)
    need(order >= 0 and every >= 1, "the order of the sets is wrong")
    for t, (slope, middle, radius) in enumerate(zip(*claims, strict=True)):
        if order and t and t % every == 0:
            wide, thin = reduced(wide, thin, order)
        box = up(np.abs(thin).sum(-1))
        reach = up(np.abs(centre) + np.abs(wide).sum(-1) + box)
        sets = (centre, wide, box, reach)
        program = head["programs"]["following" if t else "first"]
        s, c, r, bottom, top = bound(program, head["unit"], sets, low, high)
        count = total + 1 + docks + (2 * d if begin else 0)
        need(begin in (0, total + 1 + docks), "the place of the motion is wrong")
        need(s.shape[1] == count, "the outputs of the loop are not those of the property")
        x, u = slice(0, size), slice(size, total)
        turn, shift = s[:, u] - slope, c[:, u] - middle
        half = up(np.abs(turn @ wide).sum(-1) + times(np.abs(turn), box))
        fine = 4 * E * (times(np.abs(s[:, u]) + np.abs(slope), reach) + np.abs(c[:, u]))
        off = np.abs(times(turn, centre) + shift) + half + fine + r[:, u]
        need(up(off) <= radius, f"the policy leaves its claimed bounds in step {t}")
        s, c = np.concatenate([s[:, x], slope], 1), np.concatenate([c[:, x], middle], 1)
        r = np.concatenate([r[:, x], radius], 1)
        fine = 4 * E * (times(np.abs(s), reach) + np.abs(c))
        fine[:, :linear] += r[:, :linear]
        centre = times(s, centre) + c
        new = (r[:, :, None] * np.eye(total))[:, :, linear:]
        wide = np.concatenate([s @ wide, new], 2)
        thin = np.concatenate([s @ thin, fine[:, :, None] * np.eye(total)], 2)
        half = up(np.abs(wide).sum(-1) + np.abs(thin).sum(-1)) + E * np.abs(centre)
        low, high = (
            np.maximum(bottom[:, :total], centre - half),
            np.minimum(top[:, :total], centre + half),
        )
        least, most = (bottom[:, begin:], top[:, begin:]) if begin else (low, high)
        far, near = np.maximum(np.abs(least), np.abs(most)), np.maximum(np.maximum(least, -most), 0)
        norms = [np.sqrt((v**2).sum(1)) for v in (far[:, d : 2 * d], far[:, :d], -near[:, :d])]
        now = (bottom[:, total], up(norms[0]), up(norms[1]), norms[2] * (1 - E))
        if before is None:
            worst = now[0]
        else:
            top_of = [np.maximum(a, b) for a, b in zip(before[1:], now[1:], strict=True)]
            worst = np.minimum(worst, np.minimum(before[0], now[0]) - gap(head["plant"], *top_of))
        before, deep = now, bottom[:, total + docks]
    return worst, deep


def read(path):
    """Return the header of a certificate with its numbers in place, and its arrays."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    head = json.loads(str(arrays["header"]))
    for name, program in head["programs"].items():
        program["ops"] = [
            (
                kind,
                keys,
                key,
                [
                    [arrays[f"{name}/{i}/{j}/{x}"] for x in ("value", "radius")]
                    for j in range(count)
                ],
            )
            for i, (kind, keys, key, _, count) in enumerate(program["ops"])
        ]
    return head, arrays


def main(path, *others):
    """Check a certificate, and that the others are about the same loop."""
    head, arrays = read(path)
    for other in others:
        a, b = (
            json.dumps(
                [h.get(key) for key in SAME],
                default=np.ndarray.tolist,
            )
            for h in (head, read(other)[0])
        )
        need(a == b, "the loop is not that of the other certificate")
    low, high = arrays["proved/low"], arrays["proved/high"]
    fill(low, high, arrays["box/low"][0], arrays["box/high"][0])
    claims = [np.moveaxis(arrays[f"claims/{name}"], 1, 0) for name in ("slope", "centre", "radius")]
    need(
        [len(c) == head["steps"] + 1 and c.shape[1] == len(low) for c in claims],
        "claims are missing",
    )
    goal, steps = head["property"], head["steps"]
    last = arrays.get("proved/last", np.zeros(0, int))
    need(goal in ("safe", "docks"), f"the property {goal!r} is unknown")
    need(last.shape == (len(low),), "the last steps of boxes are missing")
    need(
        (last >= 1) & (last <= steps) if goal == "docks" else last == steps, "a last step is wrong"
    )
    worst = np.inf
    for end in np.unique(last):
        alike = np.flatnonzero(last == end)
        for part in np.array_split(alike, -(-len(alike) // 32)):
            kept = [c[: end + 1, part] for c in claims]
            margins, deep = follow(head, low[part], high[part], kept)
            need(margins >= 0, "the margin of a box may be negative")
            if goal == "docks":
                need(deep >= 0, f"a box may not have docked after {end} steps")
            worst = min(worst, margins.min())
    until = "until it docks, within" if goal == "docks" else "for"
    print(f"proved: {len(low)} boxes fill the box, h >= {worst:.3g} {until} {steps} steps")


if __name__ == "__main__":
    with np.errstate(all="ignore"):
        main(*sys.argv[1:])
