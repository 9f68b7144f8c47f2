"""What theory says of the energy study: the text of its explanations, without numbers of any run."""

WHY = """## Why

**Why a symplectic tableau on (q_i, v_i) is not a symplectic map.** With the constraints eliminated, the motion of the
independent coordinates has the kinetic energy v_iᵀ m(q_i) v_i / 2, with m = Tᵀ M T and v = T v_i. What the true
motion preserves is the area in the plane of q_i and its momentum p_i = m(q_i) v_i, not in the plane of q_i and v_i,
because m changes along the motion. A symplectic tableau (b_i a_ij + b_j a_ji = b_i b_j) makes a Runge–Kutta map
symplectic only if it is applied to canonical variables; applied to (q_i, v_i) it is an ordinary method of its order,
since Runge–Kutta methods do not commute with a nonlinear change of variables such as p_i = m(q_i) v_i. Then nothing
forbids its error from adding up in the energy, period after period.

**What symmetry does instead.** The linkage swings back the way it came: with the velocities reversed, the same motion
runs backwards. A symmetric tableau (Gauss, Lobatto IIIE; Newmark with γ = 1/2) keeps this reversibility in whatever
variables, so what the energy gains on the way out it gives back on the way home. Sun's Radau IIB is symplectic and
not symmetric, Radau IIA is neither. Gauss and Lobatto IIIE in momenta are both. It is the swinging back that helps:
in `tests/test_turning_crank.py` the first linkage is started so fast that its crank turns round and round, and there
Gauss(3) on (q_i, v_i) drifts, while on (q_i, p_i) with one partition it does not.

**What changing the partition does.** On each partition the discrete motion of a symplectic method, or of a reversible
one that swings back, follows an energy of its own, H + h^p H_p, and H_p depends on the chart (q_i). Where the chart
changes, that energy jumps by the difference of the two H_p at that point: of order h^p, whatever the variables. Where
the changes there and back happen at mirrored states, (q, v) and (q, −v), the sum of the two jumps is twice that part
of the difference that is odd in v. It is none with a symmetric tableau, whose H_p is even in v; Sun's H_5 is odd, and
the jumps add. A partition that lasts until it is worn changes late in both directions, at states that are not
mirrored, and the jumps need not cancel. A partition chosen in the middle of the step, by full pivoting, is the same
for the step and its reverse. On a motion that does not swing back the jumps need not cancel either way.

**What variable steps do.** A step size that depends on the estimated error makes each step another map, with another
H_p. The sequence of steps out and home is not mirrored, because each step follows from the one before; symplecticity
and reversibility are both lost. (Hairer, Lubich and Wanner, *Geometric Numerical Integration*, chapters V, VIII and
IX, have the theory.) In the Runge–Kutta methods other than PaperIRK the accepted state is moreover the extrapolated
one, which is not the tableau's."""

ORDERS = """Expected are: 5 for Radau IIA, the order of the method; 5 for Sun's tableau across mirrored changes of
the partition, where jumps of order h^5 add up; and 7 for Sun's method on (q_i, v_i) and one partition. That it is not
5 has two reasons. Sun's tableau is conjugate to a method of order 6: with a fixed map χ = identity + O(h^5), χ ∘ step
∘ χ⁻¹ is of order 6 (`tests/test_tableaux.py` solves the conditions for χ over all rooted trees; Radau IIA's have no
solution). So its error of order h^5 is a change of variables, which does not add up while the variables stay the
same, and does at changes of the partition, since χ depends on them. And the error of order h^6 has the parity of a
symmetric method's: what it does to the energy on the way out it undoes on the way home. At small steps the drift is
therefore easily overlooked, but it is no property of a symplectic map, whose drift vanishes. Where the partition
lasts until worn, no order is expected: the place at which a partition wears out jumps from one step to the next."""
