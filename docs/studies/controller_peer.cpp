// A handwritten tick with Pinocchio and DAQP: the dynamics, Jacobians and drifts that the tasks need, then the QP,
// which DAQP solves from its last active set.  The QPs are read from a file of the controller in Python, so that
// their assembly is not timed.  Arguments: model, ticks.  Prints the nanoseconds of each tick on a line.  Fails if a
// solution differs from the solution of Python.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <vector>

#include <pinocchio/algorithm/center-of-mass.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

extern "C" {
#include "api.h"
#include "utils.h"
}

using Vector = Eigen::VectorXd;

static FILE *file;

template <class T> static bool read(std::vector<T> &to) {
    return std::fread(to.data(), sizeof(T), to.size(), file) == to.size();
}

int main(int count, char **arguments) {
    if (count < 3) return 2;
    pinocchio::Model model;
    pinocchio::serialization::loadFromBinary(model, arguments[1]);
    pinocchio::Data data(model);
    file = std::fopen(arguments[2], "rb");
    std::vector<int> sizes(3);
    if (!file || !read(sizes)) return 2;
    const int n = sizes[0], m = sizes[1];
    const auto of = [](int k) { return static_cast<std::size_t>(k); };
    std::vector<int> frames(of(sizes[2])), sense(of(n + m));
    std::vector<double> state(of(model.nq + model.nv)), H(of(n * n)), g(of(n)), A(of(m * n));
    std::vector<double> upper(of(n + m)), lower(of(n + m)), wanted(of(n)), x(of(n)), multipliers(of(n + m));
    if (!read(frames) || !read(sense)) return 2;
    pinocchio::Data::Matrix6x J(6, model.nv);
    DAQPProblem qp{};
    DAQPWorkspace work{};
    DAQPResult result{};
    qp.n = n, qp.m = n + m, qp.ms = n, qp.H = H.data(), qp.f = g.data(), qp.A = A.data();
    qp.bupper = upper.data(), qp.blower = lower.data(), qp.sense = sense.data();
    result.x = x.data(), result.lam = multipliers.data();
    const Vector zero = Vector::Zero(model.nv);
    double sum = 0;
    for (bool first = true; read(state) && read(H) && read(g) && read(A) && read(upper) && read(lower) && read(wanted);
         first = false) {
        const Vector q = Eigen::Map<Vector>(state.data(), model.nq), v = Eigen::Map<Vector>(state.data() + model.nq, model.nv);
        if (first && setup_daqp(&qp, &work, nullptr) < 0) return 3;
        work.settings->primal_tol = 1e-9;
        const auto from = std::chrono::steady_clock::now();
        pinocchio::crba(model, data, q, pinocchio::Convention::WORLD);
        pinocchio::nonLinearEffects(model, data, q, v);
        pinocchio::centerOfMass(model, data, q, v, zero, false);
        pinocchio::computeJointJacobians(model, data, q);
        sum += pinocchio::jacobianCenterOfMass(model, data, false)(0, 0);
        for (const int frame : frames) {
            const auto id = pinocchio::FrameIndex(frame);
            const auto world = pinocchio::LOCAL_WORLD_ALIGNED;
            pinocchio::updateFramePlacement(model, data, id);
            J.setZero();
            pinocchio::getFrameJacobian(model, data, id, world, J);
            sum += J(0, 0) + pinocchio::getFrameClassicalAcceleration(model, data, id, world).linear()[0];
        }
        const int failed = daqp_update_ldp(DAQP_UPDATE_Rinv | DAQP_UPDATE_M | DAQP_UPDATE_v | DAQP_UPDATE_d, &work, &qp);
        if (failed >= 0) daqp_solve(&result, &work);
        const auto to = std::chrono::steady_clock::now();
        double off = 0, size = 1;
        for (int i = 0; i < n; i++) {
            off = std::fmax(off, std::fabs(x[of(i)] - wanted[of(i)]));
            size = std::fmax(size, std::fabs(wanted[of(i)]));
        }
        if (failed < 0 || result.exitflag != 1 || !(off <= 1e-6 * size)) {
            std::printf("differs by %g of %g, flag %d\n", off, size, result.exitflag);
            return 4;
        }
        std::printf("%lld\n", (long long)std::chrono::duration_cast<std::chrono::nanoseconds>(to - from).count());
    }
    return std::isfinite(sum) ? 0 : 5;
}
