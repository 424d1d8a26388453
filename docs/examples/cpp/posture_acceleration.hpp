// Impact-robust posture acceleration with Eigen and an export of `impact-posture codegen ... --prefix arm`:
//
//   a* = Kp (q_des - q) - Kd v - K grad H(q)
//
// where the difference is the manifold difference on the tangent space at q, as in Pinocchio.
#ifndef POSTURE_ACCELERATION_HPP
#define POSTURE_ACCELERATION_HPP

#include "arm.h"

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <cmath>

#ifndef FLOATING_BASE
#error "-DFLOATING_BASE=1 if arm.h says that q begins with x, y, z, qx, qy, qz, qw of the base, else -DFLOATING_BASE=0"
#endif

namespace impact {

static_assert(ARM_NQ == ARM_NV + FLOATING_BASE,
  "FLOATING_BASE does not fit arm.h, or a joint has more numbers in q than in v (cosine and sine, quaternion)");

using Real = arm_real;
using Vector3 = Eigen::Matrix<Real, 3, 1>;
using Configuration = Eigen::Matrix<Real, ARM_NQ, 1>;
using Tangent = Eigen::Matrix<Real, ARM_NV, 1>;

struct Gains {
  Real Kp, Kd, K;
};

#if FLOATING_BASE
// Rotation vector of a unit quaternion, with an angle of at most pi.
inline Vector3 log_rotation(Eigen::Quaternion<Real> r)
{
  if (r.w() < 0) {
    r.coeffs() = -r.coeffs();
  }
  const Real sine = r.vec().norm();
  // 2 atan(x) / x tends to 2 if the rotation tends to zero.
  const Real ratio = sine < Real(1e-8) ? Real(2) : 2 * std::atan2(sine, r.w()) / sine;
  return ratio * r.vec();
}

// Twist in the axes of a that takes the base from a to b in unit time: the logarithm of SE(3).
inline Eigen::Matrix<Real, 6, 1> base_difference(const Configuration &a, const Configuration &b)
{
  const Eigen::Quaternion<Real> Ra(a.template segment<4>(3)), Rb(b.template segment<4>(3));
  const Vector3 w = log_rotation(Ra.conjugate() * Rb);
  const Vector3 p = Ra.conjugate() * Vector3(b.template head<3>() - a.template head<3>());
  const Real square = w.squaredNorm(), half = std::sqrt(square) / 2;
  // (1 - half / tan(half)) / square, by its series if this expression loses digits.
  const Real c = half < Real(0.025) ? (1 + square / 60 + square * square / 2520) / 12
                                    : (1 - half / std::tan(half)) / square;
  Eigen::Matrix<Real, 6, 1> twist;
  twist << p - w.cross(p) / 2 + c * w.cross(w.cross(p)), w;
  return twist;
}
#endif

// b - a on the tangent space at a.
inline Tangent difference(const Configuration &a, const Configuration &b)
{
  Tangent d;
#if FLOATING_BASE
  d.template head<6>() = base_difference(a, b);
#endif
  constexpr int joints = ARM_NV - 6 * FLOATING_BASE;
  d.template tail<joints>() = b.template tail<joints>() - a.template tail<joints>();
  return d;
}

// Returns the code of arm_eval.  With codes 1 and 2 (q or n is not valid), `a` keeps its value: repeat the last
// command. With code 3 (H does not exist at this q), `a` is computed without the gradient.
inline int posture_acceleration(const Configuration &q, const Tangent &v, const Configuration &q_des, const Vector3 &n,
  const Gains &gains, Tangent &a)
{
  Real H;
  Tangent gradient;
  const int code = arm_eval(q.data(), n.data(), &H, gradient.data());
  if (code == 1 || code == 2) {
    return code;
  }
  if (code == 3) {
    gradient.setZero();
  }
  a = gains.Kp * difference(q, q_des) - gains.Kd * v - gains.K * gradient;
  return code;
}

}  // namespace impact

#endif
