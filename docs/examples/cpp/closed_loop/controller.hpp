// Wraps an export of `impact-posture codegen ROBOT --controller ... --prefix controller` in one small class.
#ifndef CLOSED_LOOP_CONTROLLER_HPP
#define CLOSED_LOOP_CONTROLLER_HPP

#include "controller.h"

#include <array>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <string>

class Controller {
public:
  Controller() : context_(new controller_context)
  {
    controller_params params;
    controller_default_params(&params);
    const int refused = controller_init(context_.get(), &params);
    if (refused) {
      throw std::runtime_error("parameter " + std::to_string(refused) + " of the controller is refused");
    }
  }

  void reset(const double *q)
  {
    if (controller_reset(context_.get(), q, std::array<double, CONTROLLER_NV>{}.data(), &command_)) {
      throw std::runtime_error("the controller cannot start there");
    }
#ifdef END_EFFECTOR
    home_ = context_->target[END_EFFECTOR];
#endif
  }

  void tick(double t, const double *q, const double *v, const double *force)
  {
    // The sensor measures a force; the moment of this force about the tip is zero.
    double wrench[6] = {};
    for (int i = 0; force && i < 3; ++i) {
      wrench[i] = force[i];
    }
    controller_tick(context_.get(), t, q, v, force ? wrench : nullptr, &command_);
  }

  void brace(double t) { controller_brace(context_.get(), t); }

  // Lead the tip along a direction: distance, speed and acceleration.
  void lead(const double *direction, const std::array<double, 3> &reference)
  {
#ifdef END_EFFECTOR
    auto &target = context_->target[END_EFFECTOR];
    for (int i = 0; i < 3; ++i) {
      target.position[i] = home_.position[i] + reference[0] * direction[i];
      target.velocity[i] = reference[1] * direction[i];
      target.acceleration[i] = reference[2] * direction[i];
    }
#else
    (void)direction;
    (void)reference;
#endif
  }

  const double *rotor_speed() const { return command_.rotor_speed; }
  // In u, the joint torques come after the thrusts of the rotors.
  const double *torque() const { return command_.u + CONTROLLER_ROTORS; }
  bool relaxed() const { return command_.status == CONTROLLER_RELAXED; }
  bool held() const { return command_.status > CONTROLLER_RELAXED; }

private:
  std::unique_ptr<controller_context> context_;
  controller_command command_{};
#ifdef END_EFFECTOR
  controller_target home_{};
#endif
};

#endif
