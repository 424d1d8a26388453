// H = aᵀa with M a = Jᵀn, and its tangent gradient, in Pinocchio C++: what a user who knows the library would write.
//
// Every formulation is ∇H = 2 ∂_q[nᵀJb − bᵀMa] with M b = a (the letters a, b held fixed); they differ in who does
// the work:
//   rnea   crba + cholesky + computeRNEADerivatives (its dτ/dq, transposed, times b), stock algorithms only
//   chol   crba + cholesky, the gradient by two velocity sweeps and one backward sweep over Pinocchio's spatial types
//   aba    aba() for a, its factorization kept for b, the gradient as in chol
//   hand   no stock algorithm at all: articulated bodies in world axes over Pinocchio's joints and spatial types
// The sweeps are in world axes: subtrees' forces then only add up.  One model at a time; not re-entrant.

#include <algorithm>
#include <cmath>
#include <string>

#include "pinocchio/algorithm/aba.hpp"
#include "pinocchio/algorithm/cholesky.hpp"
#include "pinocchio/algorithm/crba.hpp"
#include "pinocchio/algorithm/kinematics.hpp"
#include "pinocchio/algorithm/rnea-derivatives.hpp"

#include "pinocchio_peer.hpp"

namespace
{
// ---- rnea: stock algorithms -----------------------------------------------------------------------------------

void factor_crba(Peer & p)
{
  pinocchio::crba(p.model, p.data, p.q, pinocchio::Convention::WORLD);
  pinocchio::cholesky::decompose(p.model, p.data);
  columns(p, false);
}

double value_chol(Peer & p, const Vector3 & n)
{
  factor_crba(p);
  generalized(p, impact(p, n), p.a);
  pinocchio::cholesky::solve(p.model, p.data, p.a);
  return p.a.squaredNorm();
}

double eval_rnea(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_chol(p, n);
  p.b = p.a;
  pinocchio::cholesky::solve(p.model, p.data, p.b);
  const Force w = impact(p, n);
  p.dq.setZero();
  p.dv.setZero();
  p.da.setZero();
  pinocchio::computeRNEADerivatives(p.model, p.data, p.q, p.zero, p.a, p.dq, p.dv, p.da);
  Eigen::Map<Vector> out(grad, p.model.nv);
  out.noalias() = -2.0 * (p.dq.transpose() * p.b);
  // The contact direction's term: ∂_q nᵀJb along the contact's joints.
  for (auto at = p.support.rbegin(); at != p.support.rend(); ++at) {
    const Index i = *at, parent = p.model.parents[i];
    if (free_flyer(p, i)) {
      p.vb[i] = p.data.oMi[i].act(Motion(p.b.template segment<6>(p.model.idx_vs[i])));
    } else {
      p.vb[i].toVector() = p.vb[parent].toVector() + p.S[i] * p.b[p.model.idx_vs[i]];
    }
  }
  const Vector3 turn = turning(p, n);
  for (const Index i : p.support) {
    Force t = p.vb[p.model.parents[i]].cross(w);
    t.angular() += turn;
    const int at = p.model.idx_vs[i];
    if (free_flyer(p, i)) {
      out.template segment<6>(at) -= 2.0 * p.data.oMi[i].actInv(t).toVector();
    } else {
      out[at] -= 2.0 * p.S[i].dot(t.toVector());
    }
  }
  return H;
}

// ---- chol: stock factorization, sweeps by hand ----------------------------------------------------------------

double eval_chol(Peer & p, const Vector3 & n, double * grad)
{
  factor_crba(p);
  columns(p, true);
  generalized(p, impact(p, n), p.a);
  pinocchio::cholesky::solve(p.model, p.data, p.a);
  p.b = p.a;
  pinocchio::cholesky::solve(p.model, p.data, p.b);
  velocities(p, p.a, p.va);
  velocities(p, p.b, p.vb);
  gradient(p, n, grad);
  return p.a.squaredNorm();
}

// ---- hand and aba: articulated bodies -------------------------------------------------------------------------

// Articulated inertias in world axes; U = I^A S, 1/(Sᵀ U + armature).
void factor_hand(Peer & p)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    p.Ia[i] = p.data.oinertias[i].matrix();
  }
  for (Index i = (Index)p.model.njoints - 1; i > 0; --i) {
    const Index parent = p.model.parents[i];
    if (free_flyer(p, i)) {
      p.base.compute(p.Ia[i]);
      continue;
    }
    p.U[i].noalias() = p.Ia[i] * p.S[i];
    p.reciprocal[i] = 1.0 / (p.S[i].dot(p.U[i]) + p.model.armature[p.model.idx_vs[i]]);
    if (parent > 0) {
      p.Ia[parent] += p.Ia[i];
      p.Ia[parent].noalias() -= (p.U[i] * p.reciprocal[i]) * p.U[i].transpose();
    }
  }
}

// What aba() leaves of its factorization.
void factor_aba(Peer & p)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    if (free_flyer(p, i)) {
      p.base.compute(p.data.oYaba[i]);
    }
  }
}

struct Factors : pinocchio::fusion::JointUnaryVisitorBase<Factors>
{
  typedef boost::fusion::vector<Peer &> ArgsType;

  template<typename JointModel>
  static void algo(
    const pinocchio::JointModelBase<JointModel> & joint,
    pinocchio::JointDataBase<typename JointModel::JointDataDerived> & jdata,
    Peer & p)
  {
    take(p, joint.id(), jdata);
  }

  template<typename JointData>
  static typename std::enable_if<JointData::NV == 1>::type
  take(Peer & p, Index i, pinocchio::JointDataBase<JointData> & jdata)
  {
    p.U[i] = jdata.U();
    p.reciprocal[i] = jdata.Dinv()(0, 0);
    p.S[i] = p.data.J.col(p.model.idx_vs[i]);
  }

  template<typename JointData>
  static typename std::enable_if<JointData::NV != 1>::type
  take(Peer &, Index, pinocchio::JointDataBase<JointData> &)
  {
  }
};

// Forward half of a solve: rates and link velocities from the joints' torques and the base's bias.
template<typename Motions>
void outward(Peer & p, Vector & rates, Motions & v)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    const Index parent = p.model.parents[i];
    const int at = p.model.idx_vs[i];
    if (free_flyer(p, i)) {
      v[i] = Motion(p.base.solve(-p.bias[i].toVector()));
      rates.template segment<6>(at) = p.data.oMi[i].actInv(v[i]).toVector();
    } else {
      const Vector6 & moved = v[parent].toVector();
      const double rate = (p.torque[i] - p.U[i].dot(moved)) * p.reciprocal[i];
      v[i].toVector() = moved + p.S[i] * rate;
      rates[at] = rate;
    }
  }
}

// M a = Jᵀn: only the contact's own joints carry a bias.
void solve_impact(Peer & p, const Force & w)
{
  std::fill(p.torque.begin(), p.torque.end(), 0.0);
  Vector6 bias = -w.toVector();
  for (const Index i : p.support) {
    if (free_flyer(p, i)) {
      p.bias[i] = Force(bias);
      break;
    }
    p.torque[i] = -p.S[i].dot(bias);
    bias += p.U[i] * (p.reciprocal[i] * p.torque[i]);
  }
  outward(p, p.a, p.va);
}

// M b = a.
void solve_rates(Peer & p)
{
  clear_bias(p);
  for (Index i = (Index)p.model.njoints - 1; i > 0; --i) {
    const Index parent = p.model.parents[i];
    if (free_flyer(p, i)) {
      p.bias[i] -= p.data.oMi[i].act(Force(p.a.template segment<6>(p.model.idx_vs[i])));
      continue;
    }
    p.torque[i] = p.a[p.model.idx_vs[i]] - p.S[i].dot(p.bias[i].toVector());
    if (parent > 0) {
      p.bias[parent].toVector() += p.bias[i].toVector() + p.U[i] * (p.reciprocal[i] * p.torque[i]);
    }
  }
  outward(p, p.b, p.vb);
  clear_bias(p);
}

double value_hand(Peer & p, const Vector3 & n)
{
  place(p);
  factor_hand(p);
  solve_impact(p, impact(p, n));
  return p.a.squaredNorm();
}

double eval_hand(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_hand(p, n);
  solve_rates(p);
  gradient(p, n, grad);
  return H;
}

double value_aba(Peer & p, const Vector3 & n)
{
  pinocchio::forwardKinematics(p.model, p.data, p.q);
  p.fext[p.contact] = p.data.oMi[p.contact].actInv(impact(p, n));
  p.a = pinocchio::aba(p.model, p.data, p.q, p.zero, p.zero, p.fext, pinocchio::Convention::WORLD);
  return p.a.squaredNorm();
}

double eval_aba(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_aba(p, n);
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    Factors::run(p.model.joints[i], p.data.joints[i], Factors::ArgsType(p));
    p.va[i] = p.data.oa_gf[i];
  }
  factor_aba(p);
  solve_rates(p);
  gradient(p, n, grad);
  return H;
}

template<double (*F)(Peer &, const Vector3 &, double *)>
int call(const double * q, const double * n, double * H, double * grad)
{
  peer->q = Eigen::Map<const Vector>(q, peer->model.nq);
  *H = F(*peer, Eigen::Map<const Vector3>(n), grad);
  return std::isfinite(*H) ? 0 : 3;
}

template<double (*F)(Peer &, const Vector3 &)>
int call(const double * q, const double * n, double * H)
{
  peer->q = Eigen::Map<const Vector>(q, peer->model.nq);
  *H = F(*peer, Eigen::Map<const Vector3>(n));
  return std::isfinite(*H) ? 0 : 3;
}
Joint joint(int kind, const Vector3 & axis)
{
  switch (kind) {
  case 0: return Joint(pinocchio::JointModelRevoluteTpl<double, 0, 0>());
  case 1: return Joint(pinocchio::JointModelRevoluteTpl<double, 0, 1>());
  case 2: return Joint(pinocchio::JointModelRevoluteTpl<double, 0, 2>());
  case 3: return Joint(pinocchio::JointModelRevoluteUnalignedTpl<double, 0>(axis));
  case 4: return Joint(pinocchio::JointModelPrismaticTpl<double, 0, 0>());
  case 5: return Joint(pinocchio::JointModelPrismaticTpl<double, 0, 1>());
  case 6: return Joint(pinocchio::JointModelPrismaticTpl<double, 0, 2>());
  case 7: return Joint(pinocchio::JointModelPrismaticUnalignedTpl<double, 0>(axis));
  default: return Joint(pinocchio::JointModelFreeFlyerTpl<double, 0>());
  }
}
}  // namespace

extern "C" {
// Per joint (the world left out): parent; kind X Y Z as 0 1 2 (3 any other axis), 4 more if prismatic, 8 a free-flyer;
// axis; placement as translation and rotation by columns; mass, center of mass, inertia about it by columns.
// Returns 0, or why this model is not for the peer: 1 a joint of more than one degree of freedom (but a free-flyer at
// the root), 2 armature on the free-flyer.
int peer_load(
  int count, const int * parents, const int * kinds, const double * axes, const double * placements,
  const double * inertias, const double * armature, int contact, const double * position)
{
  Model model;
  for (int k = 0; k < count; ++k) {
    const Vector3 axis = Eigen::Map<const Vector3>(axes + 3 * k);
    const double * at = placements + 12 * k;
    const double * body = inertias + 13 * k;
    const SE3 placement(Eigen::Map<const Eigen::Matrix3d>(at + 3), Eigen::Map<const Vector3>(at));
    const Index i = model.addJoint((Index)parents[k], joint(kinds[k], axis), placement, "joint" + std::to_string(k));
    const Eigen::Matrix3d I = Eigen::Map<const Eigen::Matrix3d>(body + 4);
    model.inertias[i] = pinocchio::Inertia(body[0], Eigen::Map<const Vector3>(body + 1), I);
  }
  model.armature = Eigen::Map<const Vector>(armature, model.nv);
  model.gravity.setZero();
  for (Index i = 1; i < (Index)model.njoints; ++i) {
    const bool root = i == 1 && model.nvs[i] == 6;
    if (model.nvs[i] != 1 && !root) {
      return 1;
    }
    if (root && !model.armature.head<6>().isZero()) {
      return 2;
    }
  }
  delete peer;
  peer = new Peer(model);
  Peer & p = *peer;
  const std::size_t links = (std::size_t)model.njoints;
  p.contact = (Index)contact;
  p.position = Eigen::Map<const Vector3>(position);
  for (Index i = p.contact; i > 0; i = model.parents[i]) {
    p.support.push_back(i);
  }
  p.q.resize(model.nq);
  p.zero = p.a = p.b = Vector::Zero(model.nv);
  p.dq = p.dv = p.da = Eigen::MatrixXd::Zero(model.nv, model.nv);
  p.fext.assign(links, Force::Zero());
  p.va.assign(links, Motion::Zero());
  p.vb = p.va;
  p.bias.assign(links, Force::Zero());
  p.Fa = p.Fb = p.bias;
  p.Ia.assign(links, Matrix6::Zero());
  p.S.assign(links, Vector6::Zero());
  p.U = p.S;
  p.reciprocal.assign(links, 0.0);
  p.torque.assign(links, 0.0);
  return 0;
}

int peer_eval_rnea(const double * q, const double * n, double * H, double * g) { return call<eval_rnea>(q, n, H, g); }
int peer_eval_chol(const double * q, const double * n, double * H, double * g) { return call<eval_chol>(q, n, H, g); }
int peer_eval_aba(const double * q, const double * n, double * H, double * g) { return call<eval_aba>(q, n, H, g); }
int peer_eval_hand(const double * q, const double * n, double * H, double * g) { return call<eval_hand>(q, n, H, g); }
int peer_value_chol(const double * q, const double * n, double * H) { return call<value_chol>(q, n, H); }
int peer_value_aba(const double * q, const double * n, double * H) { return call<value_aba>(q, n, H); }
int peer_value_hand(const double * q, const double * n, double * H) { return call<value_hand>(q, n, H); }
}
