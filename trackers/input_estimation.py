"""Modified input estimation: a constant-velocity filter that regresses its last innovations on an unknown acceleration.

    x_k = F x_{k−1} + C u_{k−1} + G w_{k−1},   z_k = H x_k + v_k,   C = G = [T²/2 I; T I],   w ~ N(0, q² I)

The filter assumes u = 0. What an acceleration of the last s steps did to its state and to its innovations is linear,
with the sensitivities D_l of the state (eq 3) and Φ_{m,l} of innovation m (eq 4) to the input of step l. Kept are
their sums over all inputs since l, the response to an acceleration that is constant since then:

    E_q = D_{k−1} + … + D_{k−1−q}       B_{p,q} = L⁻¹ (Φ_{m,m−1} + … + Φ_{m,k−1−q}),   m = k − p,   S_m = L Lᵀ

so that ages count backwards from the scan, nothing but ages changes when the window moves on, and E_{s−1}, B_{·,s−1}
are what the regression needs. The recursion of a step with gain K = P⁻Hᵀ S⁻¹ (G = P⁻Hᵀ L⁻ᵀ, w = L⁻¹ν):

    E⁻_0 = C,   E⁻_{q+1} = F E_q + C;     B_{0,q} = L⁻¹ H E⁻_q,   E_q = E⁻_q − G B_{0,q};     older B, w: one step older

    Σ_u = (Σ_p BᵀB)⁻¹,   û = Σ_u Σ_p Bᵀw,     maneuver if ûᵀ Σ_u⁻¹ û > λ        (B = B_{p,s−1}; eqs 5–8)

On detection (with O = E_{s−1} − E_{s−2}, the response to the oldest input alone):

    output      y = x + E_{s−1} û,   Π = P + E_{s−1} Σ_u E_{s−1}ᵀ                            (eqs 12, 29, 30)
    window      w_p ← w_p − (B_{p,s−1} − B_{p,s−2}) û                                        (eqs 9, 26)
    recursion   x ← x + O û,   P ← P + O Σ_u Oᵀ                                              (eqs 10–11, 27–28)

The younger inputs stay in x and in the innovations, so detection and estimation go on at every step. Without
detection y = x, Π = P, û = 0, and an input that leaves the window counts as zero.
A scan without weight moves the window on with zeros: it says nothing about u.
Source: Sheng et al. (2009), sections 1–4, with the specification's corrections; the classical estimator after Chan, Hu
and Plant, IEEE Trans. AES 15(2), 1979. Suffix sums and whitened entries are equivalent to the papers' D and Φ.

Layout of one filter, d numbers per position, n = 2d, a window of s scans in arrays for at least s of them:
    E [s, n, d];  w [s, d], row p the innovation of age p;  B [s(s+1)/2, d, d], entry q(q+1)/2 + p.
"""

from __future__ import annotations

import math

from trackers.compiled import helper
from trackers.position_update import correct

MAX_WINDOW = 16
"""Longest window: the work of a step grows with the window, its memory with the square."""

ESTIMABLE = 1e-10
"""Share of its own information that a component of u must keep, given the others, to count as estimable."""


@helper
def column(q):
    """Place of B_{0,q}; B_{p,q} follows after p more."""
    return q * (q + 1) // 2


# -- prediction -------------------------------------------------------------------------------------------------------


@helper
def predict_filter(x, P, T, acceleration_std, d):
    """F x and F P Fᵀ + q² G Gᵀ, in place, for x [2d] and P [2d, 2d]."""
    q2 = acceleration_std * acceleration_std
    for i in range(d):
        x[i] += T * x[d + i]
        for j in range(d):
            P[i, j] += T * (P[i, d + j] + P[d + i, j]) + T * T * P[d + i, d + j]
    for i in range(d):
        for j in range(d):
            P[i, d + j] += T * P[d + i, d + j]
            P[d + j, i] = P[i, d + j]
    for i in range(d):
        P[i, i] += 0.25 * T * T * T * T * q2
        P[d + i, d + i] += T * T * q2
        P[i, d + i] += 0.5 * T * T * T * q2
        P[d + i, i] = P[i, d + i]


@helper
def apply_input(x, u, T, d):
    """x [2d] + C u."""
    for i in range(d):
        x[i] += 0.5 * T * T * u[i]
        x[d + i] += T * u[i]


@helper
def age_sensitivities(E, T, d, E_out):
    """E⁻_0 = C and E⁻_{q+1} = F E_q + C; E_out may be E itself. Slots beyond the window hold nothing of use."""
    for q in range(E.shape[0] - 1, -1, -1):
        for j in range(d):
            for i in range(d):
                slope = E[q - 1, d + i, j] if q > 0 else 0.0
                place = E[q - 1, i, j] + T * slope if q > 0 else 0.0
                E_out[q, i, j] = place + (0.5 * T * T if i == j else 0.0)
                E_out[q, d + i, j] = slope + (T if i == j else 0.0)


# -- update -----------------------------------------------------------------------------------------------------------


@helper
def shift_window(E, w, B, s, d, E_out, w_out, B_out):
    """Everything one step older: the oldest innovation and the oldest input leave, age 0 is left to be filled.

    E is aged already (`age_sensitivities`). Slots beyond the window are 0.
    """
    for q in range(E.shape[0]):
        inside = q < s
        for i in range(2 * d):
            for j in range(d):
                E_out[q, i, j] = E[q, i, j] if inside else 0.0
        for i in range(d):
            w_out[q, i] = w[q - 1, i] if inside and q > 0 else 0.0
        for p in range(q + 1):
            for i in range(d):
                for j in range(d):
                    B_out[column(q) + p, i, j] = B[column(q - 1) + p - 1, i, j] if inside and p > 0 else 0.0


@helper
def absorb_fix(x, P, E, w, B, L, G, s, d):
    """Kalman update with the sensitivities, in place, for S = LLᵀ, G = P⁻HᵀL⁻ᵀ, w[0] = L⁻¹ν; fills B_{0,q}."""
    correct(x, P, G, w[0], d, 2 * d)
    for q in range(s):
        at = column(q)
        for j in range(d):
            for i in range(d):
                total = E[q, i, j]
                for k in range(i):
                    total -= L[i, k] * B[at, k, j]
                B[at, i, j] = total / L[i, i]
            for i in range(2 * d):
                for k in range(d):
                    E[q, i, j] -= G[i, k] * B[at, k, j]


@helper
def absorb_nothing(w, B, s, d):
    """A scan without weight: zeros at age 0."""
    for i in range(d):
        w[0, i] = 0.0
        for q in range(s):
            for j in range(d):
                B[column(q), i, j] = 0.0


@helper
def regress(w, B, s, d, u, U):
    """û [d] and Σ_u [d, d] from the window; returns ûᵀ Σ_u⁻¹ û, −1 where the window does not determine u."""
    for i in range(d):
        u[i] = 0.0
        for j in range(i + 1):
            U[i, j] = 0.0
    for p in range(s):
        at = column(s - 1) + p
        for k in range(d):
            for i in range(d):
                u[i] += B[at, k, i] * w[p, k]
                for j in range(i + 1):
                    U[i, j] += B[at, k, i] * B[at, k, j]
    return _solve_normal(U, u, d)


@helper
def _solve_normal(A, e, d):
    """Overwrite A [d, d] (lower part given) by its inverse and e [d] by A⁻¹e; returns eᵀA⁻¹e or −1."""
    for i in range(d):
        own = A[i, i]
        for j in range(i + 1):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            if j < i:
                A[i, j] /= A[j, j]
        if not A[i, i] > ESTIMABLE * own:
            return -1.0
        A[i, i] = math.sqrt(A[i, i])
    squared = 0.0
    for i in range(d):
        for k in range(i):
            e[i] -= A[i, k] * e[k]
        e[i] /= A[i, i]
        squared += e[i] * e[i]
    for i in range(d - 1, -1, -1):
        for k in range(i + 1, d):
            e[i] -= A[k, i] * e[k]
        e[i] /= A[i, i]
    _inverse_from_factor(A, d)
    return squared


@helper
def _inverse_from_factor(A, d):
    """Overwrite a lower factor [d, d] by (LLᵀ)⁻¹."""
    for j in range(d):
        A[j, j] = 1.0 / A[j, j]
        for i in range(j + 1, d):
            total = 0.0
            for k in range(j, i):
                total -= A[i, k] * A[k, j]
            A[i, j] = total / A[i, i]
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, d):
                total += A[k, i] * A[k, j]
            A[i, j] = total
            A[j, i] = total


@helper
def respond(x, P, E, u, U, older, newer, d, row):
    """x + O û and P + O Σ_u Oᵀ, in place, for O = E_older − E_newer (newer < 0: E_older alone); row [d] is scratch."""
    for i in range(2 * d):
        for a in range(d):
            row[a] = 0.0
            for b in range(d):
                o = E[older, i, b] - (E[newer, i, b] if newer >= 0 else 0.0)
                row[a] += o * U[b, a]
                x[i] += o * u[b] if a == 0 else 0.0
        for j in range(i + 1):
            for a in range(d):
                P[i, j] += row[a] * (E[older, j, a] - (E[newer, j, a] if newer >= 0 else 0.0))
            P[j, i] = P[i, j]


@helper
def compensate_window(w, B, u, s, d):
    """Take what the oldest input did out of the innovations, in place."""
    for p in range(s):
        at, before = column(s - 1) + p, column(s - 2) + p
        for i in range(d):
            for j in range(d):
                w[p, i] -= (B[at, i, j] - (B[before, i, j] if p < s - 1 else 0.0)) * u[j]


@helper
def clear_window(E, w, B, s, d):
    """Forget all inputs: the classical estimator corrects its state once and starts anew."""
    for q in range(s):
        for j in range(d):
            w[q, j] = 0.0
            for i in range(2 * d):
                E[q, i, j] = 0.0
    for at in range(column(s)):
        for i in range(d):
            for j in range(d):
                B[at, i, j] = 0.0
