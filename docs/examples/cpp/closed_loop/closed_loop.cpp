// Runs an exported controller in an exported world, in closed loop, and prints the metrics of the run.
//
//   closed_loop WORLD [brace]
//
// WORLD is the folder of `impact-posture simulate SCENARIO --export-world WORLD`.  With `brace`, the controller prepares
// for the impact.  Prints one line for each metric (docs: experiments), the statuses, and the times of the ticks.
#include "controller.hpp"
#include "world.hpp"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <functional>
#include <iostream>

namespace {

struct Row {
  double t;
  Vector v;
  double peak;
};

struct Window {
  double begin, end;
  bool touched;
};

// Runs ticks one after the other, and records the data for the metrics.
class Loop {
public:
  Loop(const Parameters &given, World &world, Controller &controller)
    : given_(given), world_(world), controller_(controller), period_(given.number("period")),
      count_(int(std::lround(period_ / world.timestep())))
  {
    const Vector &q = given.row("q");
    controller.reset(q.data());
    world.reset(q, controller.rotor_speed());
  }

  double t() const { return world_.time(); }
  double period() const { return period_; }
  double speed() const { return rows_.empty() ? 0.0 : mju_norm(rows_.back().v.data(), int(rows_.back().v.size())); }

  bool tick(int shape)
  {
    const Reading &now = world_.measured();
    const auto begin = std::chrono::steady_clock::now();
    controller_.tick(t(), now.q.data(), now.v.data(), world_.feels() ? now.force.data() : nullptr);
    const double took = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
    took_.push_back(took);
    // A real loop would continue with the last command.  In this program, the clock of the simulation waits.
    missed_ += took > period_;
    relaxed_ += controller_.relaxed();
    held_ += controller_.held();
    if (!world_.step(controller_.rotor_speed(), controller_.torque(), count_)) {
      return false;
    }
    double peak = 0;
    if (shape >= 0) {
      const std::size_t s = std::size_t(shape);
      peak = world_.peak(s);
      if (!std::isnan(world_.began(s)) && !touching_) {
        touches_.push_back(world_.began(s));
      }
      touching_ = world_.touching(s);
      world_.look();
    }
    rows_.push_back({t(), world_.truth().v, peak});
    return true;
  }

  double first_touch(double begin, double end) const
  {
    for (double t : touches_) {
      if (begin <= t && t < end) {
        return t;
      }
    }
    return std::numeric_limits<double>::quiet_NaN();
  }

  // Print the metrics of the impact windows, for a push or for contacts.
  void print(const std::vector<Window> &windows, bool push)
  {
    double way = 0, jumps = 0, force = 0;
    int made = 0;
    for (const Window &window : windows) {
      Vector before;
      double jump = 0;
      const double until = push ? window.end : window.begin + given_.number("jump");
      for (const Row &row : rows_) {
        if (row.t <= window.begin + 1e-9) {
          before = row.v;
          continue;
        }
        if (row.t <= window.end + 1e-9) {
          way += mju_norm(row.v.data(), int(row.v.size())) * period_;
          force = std::max(force, row.peak);
        }
        if (row.t <= until + 1e-9) {
          double square = 0;
          for (std::size_t i = 0; i < row.v.size(); ++i) {
            const double change = row.v[i] - (push ? 0.0 : before[i]);
            square += change * change;
          }
          jump = std::max(jump, std::sqrt(square));
        }
      }
      made += window.touched;
      jumps += window.touched ? jump : 0.0;
    }
    std::sort(took_.begin(), took_.end());
    const auto microseconds = [&](double share) {
      return 1e6 * took_[std::size_t(share * double(took_.size() - 1))];
    };
    std::printf("q_total_impact %.17g\n", way);
    std::printf("peak_jump %.17g\n", made ? jumps / made : 0.0);
    if (!push) {
      std::printf("peak_force %.17g\n", force);
    }
    std::printf("contacts %d of %zu\n", made, windows.size());
    std::printf("ticks %zu relaxed %d held %d missed %d\n", took_.size(), relaxed_, held_, missed_);
    std::printf("tick_us median %.2f p99 %.2f max %.2f\n", microseconds(0.5), microseconds(0.99), microseconds(1.0));
  }

private:
  const Parameters &given_;
  World &world_;
  Controller &controller_;
  double period_;
  int count_, relaxed_ = 0, held_ = 0, missed_ = 0;
  bool touching_ = false;
  Vector took_, touches_;
  std::vector<Row> rows_;
};

// Reference of the end effector during the approach: distance, speed and acceleration.
std::array<double, 3> reference(const Parameters &given, double t)
{
  const Vector &task = given.row("contacts", 6);
  const double settle = task[1], cycle = task[5];
  const double contact = std::fmin(std::fmax(std::floor((t - settle) / cycle), 0.0), task[0] - 1);
  double since = t - settle - contact * cycle;
  if (since < 0) {
    return {0, 0, 0};
  }
  for (const Vector &leg : given.rows("leg")) {
    if (since < leg[0]) {
      return {leg[2] + leg[3] * since + leg[1] * since * since / 2, leg[3] + leg[1] * since, leg[1]};
    }
    since -= leg[0];
  }
  return {0, 0, 0};
}

void run_contacts(const Parameters &given, Loop &loop, Controller &controller, bool brace)
{
  const Vector &task = given.row("contacts", 6), &inward = given.row("inward", 3);
  const int shape = int(given.number("touching"));
  const double settle = task[1], cycle = task[5], total = settle + task[0] * cycle;
  for (long k = 0; k < std::lround(total / loop.period()); ++k) {
    if (brace && loop.t() >= given.number("brace") - 1e-9) {
      controller.brace(loop.t());
      brace = false;
    }
    controller.lead(inward.data(), reference(given, loop.t()));
    if (!loop.tick(shape)) {
      break;
    }
  }
  std::vector<Window> windows;
  for (int k = 0; k < int(task[0]); ++k) {
    const double start = settle + k * cycle, touch = loop.first_touch(start, start + cycle);
    const double begin = std::isnan(touch) ? start + given.number("crossing") : touch;
    windows.push_back({begin, begin + task[3], !std::isnan(touch)});
  }
  loop.print(windows, false);
}

void run_push(const Parameters &given, World &world, Loop &loop, Controller &controller, bool brace)
{
  const Vector &rest = given.row("rest", 4), &push = given.row("push", 8);
  double still = 0;
  const double end = rest[0] + rest[3];
  while ((loop.t() < rest[0] - 1e-9 || still < rest[2] - 1e-9) && loop.t() <= end) {
    if (brace && loop.t() >= given.number("brace") - 1e-9) {
      controller.brace(loop.t());
      brace = false;
    }
    if (!loop.tick(-1)) {
      throw std::runtime_error("the state ran away");
    }
    still = loop.speed() < rest[1] ? still + loop.period() : 0.0;
  }
  const double begin = loop.t();
  world.push(int(push[0]), {push[1], push[2], push[3]}, {push[4], push[5], push[6]}, push[7]);
  for (long k = 0; k < std::lround((push[7] + given.number("after")) / loop.period()) && loop.tick(-1); ++k) {
  }
  std::printf("waited %.17g\n", begin);
  loop.print({{begin, begin + push[7], true}}, true);
}

}  // namespace

int main(int count, char **words)
{
  if (count < 2 || count > 3 || (count == 3 && std::strcmp(words[2], "brace") != 0)) {
    std::fprintf(stderr, "usage: closed_loop WORLD [brace]\n");
    return 2;
  }
  try {
    const Parameters given(std::string(words[1]) + "/world.txt");
    World world(words[1], given);
    Controller controller;
    Loop loop(given, world, controller);
    if (given.has("contacts")) {
      run_contacts(given, loop, controller, count == 3);
    } else {
      run_push(given, world, loop, controller, count == 3);
    }
  } catch (const std::exception &error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 1;
  }
  return 0;
}
