// A robot in world axes over Pinocchio's joints and spatial types: kinematics, velocities, and the gradient's sweeps.
//
// Joints are a collection of the one-dof types that a URDF makes, a free-flyer, and what Pinocchio's own code names.
// With all of its joint types these few algorithms take g++ -O3 above ten minutes and 5 GB; the run-time dispatch is
// the same.
#pragma once

#include <string>
#include <type_traits>
#include <vector>

#include <Eigen/Cholesky>

#include "pinocchio/multibody.hpp"

namespace impact_peer
{
template<typename S, int O>
struct FewJointsTpl
{
  typedef S Scalar;
  static constexpr int Options = O;
  template<typename M>
  using Wrapped = boost::recursive_wrapper<M>;
  typedef pinocchio::JointModelMimicTpl<S, O, FewJointsTpl> JointModelMimic;
  typedef pinocchio::JointDataMimicTpl<S, O, FewJointsTpl> JointDataMimic;
  typedef boost::variant<
    pinocchio::JointModelRevoluteTpl<S, O, 0>, pinocchio::JointModelRevoluteTpl<S, O, 1>,
    pinocchio::JointModelRevoluteTpl<S, O, 2>, pinocchio::JointModelFreeFlyerTpl<S, O>,
    pinocchio::JointModelRevoluteUnalignedTpl<S, O>, pinocchio::JointModelPrismaticTpl<S, O, 0>,
    pinocchio::JointModelPrismaticTpl<S, O, 1>, pinocchio::JointModelPrismaticTpl<S, O, 2>,
    pinocchio::JointModelPrismaticUnalignedTpl<S, O>, Wrapped<JointModelMimic>>
    JointModelVariant;
  typedef boost::variant<
    pinocchio::JointDataRevoluteTpl<S, O, 0>, pinocchio::JointDataRevoluteTpl<S, O, 1>,
    pinocchio::JointDataRevoluteTpl<S, O, 2>, pinocchio::JointDataFreeFlyerTpl<S, O>,
    pinocchio::JointDataRevoluteUnalignedTpl<S, O>, pinocchio::JointDataPrismaticTpl<S, O, 0>,
    pinocchio::JointDataPrismaticTpl<S, O, 1>, pinocchio::JointDataPrismaticTpl<S, O, 2>,
    pinocchio::JointDataPrismaticUnalignedTpl<S, O>, Wrapped<JointDataMimic>>
    JointDataVariant;
};
typedef pinocchio::ModelTpl<double, 0, FewJointsTpl> Model;
typedef pinocchio::DataTpl<double, 0, FewJointsTpl> Data;
typedef pinocchio::JointModelTpl<double, 0, FewJointsTpl> Joint;
}

namespace
{
using impact_peer::Data;
using impact_peer::Joint;
using impact_peer::Model;
using pinocchio::Force;
using pinocchio::Motion;
using pinocchio::SE3;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector3 = Eigen::Vector3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Vector = Eigen::VectorXd;
using Index = pinocchio::JointIndex;

struct Peer
{
  Model model;
  Data data;
  Index contact = 0;
  Vector3 position = Vector3::Zero();
  std::vector<Index> support;  // joints between the world and the contact, the contact's first
  Vector q, zero, a, b;
  Eigen::MatrixXd dq, dv, da;
  std::vector<Force, Eigen::aligned_allocator<Force>> fext;
  // World axes, per joint.
  std::vector<Motion, Eigen::aligned_allocator<Motion>> va, vb;
  std::vector<Force, Eigen::aligned_allocator<Force>> bias, Fa, Fb;
  std::vector<Matrix6, Eigen::aligned_allocator<Matrix6>> Ia;
  std::vector<Vector6, Eigen::aligned_allocator<Vector6>> S, U;
  std::vector<double> reciprocal, torque;
  // A free-flyer is solved for its twist: its six rates are that twist in the base's axes.
  Eigen::LLT<Matrix6> base;

  explicit Peer(const Model & m) : model(m), data(m) {}
};

Peer * peer = nullptr;

bool free_flyer(const Peer & p, Index i) { return p.model.nvs[i] == 6; }

// Forward kinematics and one dof's world column, over Pinocchio's joint models.
struct Place : pinocchio::fusion::JointUnaryVisitorBase<Place>
{
  typedef boost::fusion::vector<Peer &> ArgsType;

  template<typename JointModel>
  static void algo(
    const pinocchio::JointModelBase<JointModel> & joint,
    pinocchio::JointDataBase<typename JointModel::JointDataDerived> & jdata,
    Peer & p)
  {
    const Index i = joint.id(), parent = p.model.parents[i];
    joint.calc(jdata.derived(), p.q);
    p.data.liMi[i] = p.model.jointPlacements[i] * jdata.M();
    p.data.oMi[i] = parent > 0 ? p.data.oMi[parent] * p.data.liMi[i] : p.data.liMi[i];
    p.data.oinertias[i] = p.data.oMi[i].act(p.model.inertias[i]);
    column(p, i, p.data.oMi[i], jdata);
  }

  template<typename JointData>
  static typename std::enable_if<JointData::NV == 1>::type
  column(Peer & p, Index i, const SE3 & M, const pinocchio::JointDataBase<JointData> & jdata)
  {
    p.S[i] = M.act(jdata.S());
  }

  template<typename JointData>
  static typename std::enable_if<JointData::NV != 1>::type
  column(Peer &, Index, const SE3 &, const pinocchio::JointDataBase<JointData> &)
  {
  }
};

void place(Peer & p)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    Place::run(p.model.joints[i], p.data.joints[i], Place::ArgsType(p));
  }
}

// World columns and inertias after an algorithm of Pinocchio's has placed the links.
void columns(Peer & p, bool inertias)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    if (!free_flyer(p, i)) {
      p.S[i] = p.data.J.col(p.model.idx_vs[i]);
    }
    if (inertias) {
      p.data.oinertias[i] = p.data.oMi[i].act(p.model.inertias[i]);
    }
  }
}

// The unit impulse as a force at the world's origin.
Force impact(const Peer & p, const Vector3 & n)
{
  return Force(n, p.data.oMi[p.contact].act(p.position).cross(n));
}

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

template<typename Motions>
void velocities(const Peer & p, const Vector & rates, Motions & v)
{
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
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
}

// The contact's wrench stays in the world's axes while its link turns.
Vector3 turning(const Peer & p, const Vector3 & n)
{
  const Vector3 point = p.data.oMi[p.contact].act(p.position);
  const Motion & v = p.vb[p.contact];
  return n.cross(v.linear() + v.angular().cross(point));
}

// ∇H from a, b, their link velocities, and inertias and columns in world axes.
void gradient(Peer & p, const Vector3 & n, double * grad)
{
  const Force w = impact(p, n);
  for (Index i = 1; i < (Index)p.model.njoints; ++i) {
    p.Fa[i] = -(p.data.oinertias[i] * p.vb[i]);
    p.Fb[i] = -(p.data.oinertias[i] * p.va[i]);
  }
  p.Fb[p.contact] += w;
  const Vector3 turn = turning(p, n);
  for (const Index i : p.support) {
    p.bias[i].setZero();
    p.bias[i].angular() = turn;
  }
  for (Index i = (Index)p.model.njoints - 1; i > 0; --i) {
    const Index parent = p.model.parents[i];
    const int at = p.model.idx_vs[i];
    Force t = p.bias[i];
    if (parent > 0) {
      t += p.va[parent].cross(p.Fa[i]) + p.vb[parent].cross(p.Fb[i]);
      p.Fa[parent] += p.Fa[i];
      p.Fb[parent] += p.Fb[i];
    }
    if (free_flyer(p, i)) {
      Eigen::Map<Vector6>(grad + at) = -2.0 * p.data.oMi[i].actInv(t).toVector();
    } else {
      grad[at] = -2.0 * p.S[i].dot(t.toVector());
    }
  }
}

void clear_bias(Peer & p)
{
  for (auto & f : p.bias) {
    f.setZero();
  }
}
}  // namespace
