// H = aᵀa with M a = Jᵀn, and its tangent gradient, in Pinocchio C++, as an experienced user would write them.
//
// Every formulation computes ∇H = 2 ∂_q[nᵀJb − bᵀMa] with M b = a, where a and b are constant in ∂_q.  The formulations
// use different algorithms:
//   rnea   crba + cholesky + computeRNEADerivatives (its dτ/dq, transposed, times b), stock algorithms only
//   chol   crba + cholesky, the gradient by two velocity sweeps and one backward sweep over Pinocchio's spatial types
//   aba    aba() for a, its factorization kept for b, the gradient as in chol
//   hand   no stock algorithm at all: articulated bodies in world axes over Pinocchio's joints and spatial types
// The sweeps use world axes, in which the forces of subtrees are summed without rotation.  The library supports one
// model at a time and is not re-entrant.

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "pinocchio/algorithm/aba.hpp"
#include "pinocchio/algorithm/cholesky.hpp"
#include "pinocchio/algorithm/crba.hpp"
#include "pinocchio/algorithm/kinematics.hpp"
#include "pinocchio/algorithm/rnea-derivatives.hpp"
#include "pinocchio/multibody.hpp"

#include <Eigen/Cholesky>

namespace
{
namespace pin = pinocchio;
using pin::Force;
using pin::Motion;
using pin::SE3;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector3 = Eigen::Vector3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Vector = Eigen::VectorXd;
using Index = pin::JointIndex;
template<typename T>
using Links = std::vector<T, Eigen::aligned_allocator<T>>;

// The joints of one degree of freedom that a URDF can define, a free-flyer, and types that the code of Pinocchio names.
// With all joint types, g++ -O3 needs over ten minutes and 5 GB; the dispatch at run time is the same.
template<typename S, int O>
struct FewJointsTpl
{
  typedef S Scalar;
  static constexpr int Options = O;
  typedef pin::JointModelMimicTpl<S, O, FewJointsTpl> JointModelMimic;
  typedef pin::JointDataMimicTpl<S, O, FewJointsTpl> JointDataMimic;
#define JOINTS(Kind) \
  pin::Joint##Kind##RevoluteTpl<S, O, 0>, pin::Joint##Kind##RevoluteTpl<S, O, 1>, \
  pin::Joint##Kind##RevoluteTpl<S, O, 2>, pin::Joint##Kind##RevoluteUnalignedTpl<S, O>, \
  pin::Joint##Kind##PrismaticTpl<S, O, 0>, pin::Joint##Kind##PrismaticTpl<S, O, 1>, \
  pin::Joint##Kind##PrismaticTpl<S, O, 2>, pin::Joint##Kind##PrismaticUnalignedTpl<S, O>, \
  pin::Joint##Kind##FreeFlyerTpl<S, O>, boost::recursive_wrapper<Joint##Kind##Mimic>
  typedef boost::variant<JOINTS(Model)> JointModelVariant;
  typedef boost::variant<JOINTS(Data)> JointDataVariant;
};
typedef pin::ModelTpl<double, 0, FewJointsTpl> Model;
typedef pin::DataTpl<double, 0, FewJointsTpl> Data;
typedef pin::JointModelTpl<double, 0, FewJointsTpl> Joint;

struct Peer
{
  Model model;
  Data data;
  Index contact, links;
  Vector3 position;
  std::vector<Index> support;  // joints between the world and the contact, the contact's first
  Vector q, zero, a, b;
  Eigen::MatrixXd dq, dv, da;
  // In world axes, for each joint; only `local` is in the axes of the joint.
  Links<Motion> va, vb;
  Links<Force> local, bias, Fa, Fb;
  Links<Matrix6> Ia;
  Links<Vector6> S, U;
  std::vector<double> reciprocal, torque;
  // Factorized inertia of the base.  A solve gives the twist of the free-flyer in world axes.
  Eigen::LLT<Matrix6> base;

  Peer(const Model & m, Index contact, const Vector3 & position)
  : model(m), data(m), contact(contact), links((Index)m.njoints), position(position), zero(Vector::Zero(m.nv)),
    a(zero), b(zero), dq(Eigen::MatrixXd::Zero(m.nv, m.nv)), dv(dq), da(dq), va(links, Motion::Zero()), vb(va),
    local(links, Force::Zero()), bias(local), Fa(local), Fb(local), Ia(links, Matrix6::Zero()),
    S(links, Vector6::Zero()), U(S), reciprocal(links, 0.0), torque(links, 0.0)
  {
    for (Index i = contact; i > 0; i = m.parents[i]) {
      support.push_back(i);
    }
  }
};

Peer * peer = nullptr;

bool free_flyer(const Peer & p, Index i) { return p.model.nvs[i] == 6; }

// Computes the columns in world axes after an algorithm of Pinocchio has placed the links.
void columns(Peer & p)
{
  for (Index i = 1; i < p.links; ++i) {
    if (!free_flyer(p, i)) {
      p.S[i] = p.data.J.col(p.model.idx_vs[i]);
    }
  }
}

// The unit impulse as a spatial force at the origin of the world.
Force impulse(const Peer & p, const Vector3 & n) { return Force(n, p.data.oMi[p.contact].act(p.position).cross(n)); }

// Jᵀn.
void generalized(const Peer & p, const Force & w, Vector & tau)
{
  tau.setZero();
  for (const Index i : p.support) {
    if (free_flyer(p, i)) {
      tau.template segment<6>(p.model.idx_vs[i]) = p.data.oMi[i].actInv(w).toVector();
    } else {
      tau[p.model.idx_vs[i]] = p.S[i].dot(w.toVector());
    }
  }
}

// Velocity of a link in world axes from the velocity of its parent.
void velocity(const Peer & p, Index i, const Vector & rates, Links<Motion> & v)
{
  const Index parent = p.model.parents[i];
  const int at = p.model.idx_vs[i];
  if (free_flyer(p, i)) {
    v[i] = p.data.oMi[i].act(Motion(rates.template segment<6>(at)));
  } else if (parent > 0) {
    v[i].toVector() = v[parent].toVector() + p.S[i] * rates[at];
  } else {
    v[i].toVector() = p.S[i] * rates[at];
  }
}

// n × ṗ, where the contact point p moves with the velocity vb of its link.
Vector3 turning(const Peer & p, const Vector3 & n)
{
  const Motion & v = p.vb[p.contact];
  return n.cross(v.linear() + v.angular().cross(p.data.oMi[p.contact].act(p.position)));
}

// Component of a force (world axes) along a joint, times −2.
template<typename Out>
void project(const Peer & p, Index i, const Force & t, Out && write)
{
  if (free_flyer(p, i)) {
    const Vector6 along = p.data.oMi[i].actInv(t).toVector();
    for (int k = 0; k < 6; ++k) {
      write(p.model.idx_vs[i] + k, -2.0 * along[k]);
    }
  } else {
    write(p.model.idx_vs[i], -2.0 * p.S[i].dot(t.toVector()));
  }
}

// Computes ∇H from a, b, their link velocities, and inertias and columns in world axes.
void gradient(Peer & p, const Vector3 & n, double * grad)
{
  for (Index i = 1; i < p.links; ++i) {
    p.Fa[i] = -(p.data.oinertias[i] * p.vb[i]);
    p.Fb[i] = -(p.data.oinertias[i] * p.va[i]);
    p.bias[i].setZero();
  }
  p.Fb[p.contact] += impulse(p, n);
  const Vector3 turn = turning(p, n);
  for (const Index i : p.support) {
    p.bias[i].angular() = turn;
  }
  for (Index i = p.links - 1; i > 0; --i) {
    const Index parent = p.model.parents[i];
    Force t = p.bias[i];
    if (parent > 0) {
      t += p.va[parent].cross(p.Fa[i]) + p.vb[parent].cross(p.Fb[i]);
      p.Fa[parent] += p.Fa[i];
      p.Fb[parent] += p.Fb[i];
    }
    project(p, i, t, [&](int k, double value) { grad[k] = value; });
  }
}

double value_chol(Peer & p, const Vector3 & n)
{
  pin::crba(p.model, p.data, p.q, pin::Convention::WORLD);
  pin::cholesky::decompose(p.model, p.data);
  columns(p);
  generalized(p, impulse(p, n), p.a);
  pin::cholesky::solve(p.model, p.data, p.a);
  return p.a.squaredNorm();
}

double eval_rnea(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_chol(p, n);
  p.b = p.a;
  pin::cholesky::solve(p.model, p.data, p.b);
  p.dq.setZero();
  p.dv.setZero();
  p.da.setZero();
  pin::computeRNEADerivatives(p.model, p.data, p.q, p.zero, p.a, p.dq, p.dv, p.da);
  Eigen::Map<Vector>(grad, p.model.nv).noalias() = -2.0 * (p.dq.transpose() * p.b);
  // Term of the contact direction: ∂_q nᵀJb along the joints of the contact.
  for (auto at = p.support.rbegin(); at != p.support.rend(); ++at) {
    velocity(p, *at, p.b, p.vb);
  }
  const Force w = impulse(p, n);
  const Vector3 turn = turning(p, n);
  for (const Index i : p.support) {
    Force t = p.vb[p.model.parents[i]].cross(w);
    t.angular() += turn;
    project(p, i, t, [&](int k, double value) { grad[k] += value; });
  }
  return H;
}

double eval_chol(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_chol(p, n);
  p.b = p.a;
  pin::cholesky::solve(p.model, p.data, p.b);
  for (Index i = 1; i < p.links; ++i) {
    p.data.oinertias[i] = p.data.oMi[i].act(p.model.inertias[i]);
    velocity(p, i, p.a, p.va);
    velocity(p, i, p.b, p.vb);
  }
  gradient(p, n, grad);
  return H;
}

// Articulated inertias in world axes; U = I^A S, 1/(Sᵀ U + armature).
void factor_hand(Peer & p)
{
  for (Index i = p.links - 1; i > 0; --i) {
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

// Visitor of the joint models of Pinocchio.  With placing: forward kinematics of one joint, its inertia and column in
// world axes.  Without: the factorization that aba() has computed.
template<bool placing>
struct Visit : pin::fusion::JointUnaryVisitorBase<Visit<placing>>
{
  typedef boost::fusion::vector<Peer &> ArgsType;

  template<typename JointModel>
  static void algo(
    const pin::JointModelBase<JointModel> & joint, pin::JointDataBase<typename JointModel::JointDataDerived> & jdata,
    Peer & p)
  {
    const Index i = joint.id(), parent = p.model.parents[i];
    if constexpr (placing) {
      joint.calc(jdata.derived(), p.q);
      const SE3 moved = p.model.jointPlacements[i] * jdata.M();
      p.data.oMi[i] = parent > 0 ? p.data.oMi[parent] * moved : moved;
      p.data.oinertias[i] = p.data.oMi[i].act(p.model.inertias[i]);
      if constexpr (JointModel::NV == 1) {
        p.S[i] = p.data.oMi[i].act(jdata.S());
      }
    } else if constexpr (JointModel::NV == 1) {
      p.U[i] = jdata.U();
      p.reciprocal[i] = jdata.Dinv()(0, 0);
    } else {
      p.base.compute(p.data.oYaba[i]);
    }
  }

  static void run(Peer & p, Index i)
  {
    pin::fusion::JointUnaryVisitorBase<Visit>::run(p.model.joints[i], p.data.joints[i], ArgsType(p));
  }
};

// Forward half of a solve: computes rates and link velocities from joint torques and the bias of the base.
void outward(Peer & p, Vector & rates, Links<Motion> & v)
{
  for (Index i = 1; i < p.links; ++i) {
    const int at = p.model.idx_vs[i];
    if (free_flyer(p, i)) {
      v[i] = Motion(p.base.solve(-p.bias[i].toVector()));
      rates.template segment<6>(at) = p.data.oMi[i].actInv(v[i]).toVector();
    } else {
      const Vector6 & moved = v[p.model.parents[i]].toVector();
      rates[at] = (p.torque[i] - p.U[i].dot(moved)) * p.reciprocal[i];
      v[i].toVector() = moved + p.S[i] * rates[at];
    }
  }
}

// M b = a.
void solve_rates(Peer & p)
{
  for (Force & f : p.bias) {
    f.setZero();
  }
  for (Index i = p.links - 1; i > 0; --i) {
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
}

double value_hand(Peer & p, const Vector3 & n)
{
  for (Index i = 1; i < p.links; ++i) {
    Visit<true>::run(p, i);
    p.Ia[i] = p.data.oinertias[i].matrix();
  }
  factor_hand(p);
  // M a = Jᵀn: only joints between the contact and the base have a bias.
  std::fill(p.torque.begin(), p.torque.end(), 0.0);
  Vector6 bias = -impulse(p, n).toVector();
  for (const Index i : p.support) {
    if (free_flyer(p, i)) {
      p.bias[i] = Force(bias);
      break;
    }
    p.torque[i] = -p.S[i].dot(bias);
    bias += p.U[i] * (p.reciprocal[i] * p.torque[i]);
  }
  outward(p, p.a, p.va);
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
  pin::forwardKinematics(p.model, p.data, p.q);
  p.local[p.contact] = p.data.oMi[p.contact].actInv(impulse(p, n));
  p.a = pin::aba(p.model, p.data, p.q, p.zero, p.zero, p.local, pin::Convention::WORLD);
  return p.a.squaredNorm();
}

double eval_aba(Peer & p, const Vector3 & n, double * grad)
{
  const double H = value_aba(p, n);
  for (Index i = 1; i < p.links; ++i) {
    Visit<false>::run(p, i);
    p.va[i] = p.data.oa_gf[i];
  }
  columns(p);
  solve_rates(p);
  gradient(p, n, grad);
  return H;
}

Joint joint(int kind, const Vector3 & axis)
{
  switch (kind) {
  case 0: return pin::JointModelRevoluteTpl<double, 0, 0>();
  case 1: return pin::JointModelRevoluteTpl<double, 0, 1>();
  case 2: return pin::JointModelRevoluteTpl<double, 0, 2>();
  case 3: return pin::JointModelRevoluteUnalignedTpl<double, 0>(axis);
  case 4: return pin::JointModelPrismaticTpl<double, 0, 0>();
  case 5: return pin::JointModelPrismaticTpl<double, 0, 1>();
  case 6: return pin::JointModelPrismaticTpl<double, 0, 2>();
  case 7: return pin::JointModelPrismaticUnalignedTpl<double, 0>(axis);
  default: return pin::JointModelFreeFlyerTpl<double, 0>();
  }
}

int code_of(double H) { return std::isfinite(H) ? 0 : 3; }

Vector3 at(const double * q, const double * n)
{
  peer->q = Eigen::Map<const Vector>(q, peer->model.nq);
  return Eigen::Map<const Vector3>(n);
}
}  // namespace

extern "C" {
// Arguments for each joint, without the world: parent; kind (0, 1, 2 for the axes X, Y, Z, 3 for another axis, plus 4
// if prismatic; 8 for a free-flyer); axis; placement (translation, rotation by columns); mass, center of mass,
// inertia about the center of mass by columns.  The free-flyer must not have armature.
void peer_load(
  int count, const int * parents, const int * kinds, const double * axes, const double * placements,
  const double * inertias, const double * armature, int contact, const double * position)
{
  Model model;
  for (int k = 0; k < count; ++k) {
    const Vector3 axis = Eigen::Map<const Vector3>(axes + 3 * k);
    const double *place = placements + 12 * k, *body = inertias + 13 * k;
    const SE3 placement(Eigen::Map<const Eigen::Matrix3d>(place + 3), Eigen::Map<const Vector3>(place));
    const Index i = model.addJoint((Index)parents[k], joint(kinds[k], axis), placement, "joint" + std::to_string(k));
    const Eigen::Matrix3d I = Eigen::Map<const Eigen::Matrix3d>(body + 4);
    model.inertias[i] = pin::Inertia(body[0], Eigen::Map<const Vector3>(body + 1), I);
  }
  model.armature = Eigen::Map<const Vector>(armature, model.nv);
  model.gravity.setZero();
  delete peer;
  peer = new Peer(model, (Index)contact, Eigen::Map<const Vector3>(position));
}

#define EVAL(name) \
  int peer_eval_##name(const double * q, const double * n, double * H, double * grad) \
  { return code_of(*H = eval_##name(*peer, at(q, n), grad)); }
#define VALUE(name) \
  int peer_value_##name(const double * q, const double * n, double * H) \
  { return code_of(*H = value_##name(*peer, at(q, n))); }
EVAL(rnea) EVAL(chol) EVAL(aba) EVAL(hand) VALUE(chol) VALUE(aba) VALUE(hand)
}
