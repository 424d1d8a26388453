// The world of a scenario, as `impact-posture simulate SCENARIO --export-world DIR` writes it: MuJoCo's model, propellers
// that lag behind their commands, a filtered force sensor, and the coordinates of the controller (Pinocchio's: base
// position, quaternion x y z w, joints; velocities of the base in its own axes).
#ifndef WORLD_HPP
#define WORLD_HPP

#include <mujoco/mujoco.h>

#include <array>
#include <cmath>
#include <deque>
#include <fstream>
#include <limits>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Vector = std::vector<double>;

// Parameters by key.  If a key is on several lines, it has several rows.
class Parameters {
public:
  explicit Parameters(const std::string &path)
  {
    std::ifstream file(path);
    std::string line, key, number;
    while (std::getline(file, line)) {
      std::istringstream words(line);
      Vector row;
      words >> key;
      // Use std::stod, because streams do not read "inf".
      while (words >> number) {
        row.push_back(std::stod(number));
      }
      rows_[key].push_back(row);
    }
    if (rows_.empty()) {
      throw std::runtime_error(path + " cannot be read, or is empty");
    }
  }

  bool has(const std::string &key) const { return rows_.count(key) > 0; }

  const std::vector<Vector> &rows(const std::string &key) const
  {
    static const std::vector<Vector> none;
    const auto found = rows_.find(key);
    return found == rows_.end() ? none : found->second;
  }

  const Vector &row(const std::string &key, std::size_t least = 1) const
  {
    if (rows(key).empty() || rows(key).front().size() < least) {
      throw std::runtime_error("world.txt: '" + key + "' is missing or too short");
    }
    return rows(key).front();
  }

  double number(const std::string &key) const { return row(key).front(); }

private:
  std::map<std::string, std::vector<Vector>> rows_;
};

struct Reading {
  Vector q, v;
  std::array<double, 3> force;
};

class World {
public:
  World(const std::string &folder, const Parameters &given)
    : given_(given), model_(mj_loadModel((folder + "/world.mjb").c_str(), nullptr), mj_deleteModel),
      data_(model_ ? mj_makeData(model_.get()) : nullptr, mj_deleteData)
  {
    if (!data_) {
      throw std::runtime_error(folder + "/world.mjb cannot be loaded: another version of MuJoCo wrote it?");
    }
    // Ignore warnings, because MuJoCo must not write a log file into the working directory.  The numbers show a
    // diverged state.
    mju_user_warning = [](const char *) {};
    shape_of_.assign(std::size_t(model_->ngeom), -1);
    const auto &geoms = given_.row("shapes", 0), &shapes = given_.row("shape_of", 0);
    for (std::size_t k = 0; k < geoms.size(); ++k) {
      shape_of_.at(std::size_t(geoms[k])) = int(shapes[k]);
      shapes_ = std::size_t(shapes[k]) + 1;
    }
    rotors_ = given_.has("rotors") ? std::size_t(given_.number("rotors")) : 0;
    smoothing_ = given_.has("force_shape") ? given_.number("force_smoothing") : 0;
  }

  double timestep() const { return given_.number("timestep"); }
  double time() const { return double(steps_) * timestep(); }
  bool feels() const { return given_.has("force_shape"); }

  // Largest force along the contact normals of a shape since the last call, and time of its first touch (NaN if
  // none).
  double peak(std::size_t shape) const { return peak_[shape]; }
  double began(std::size_t shape) const { return began_[shape]; }
  bool touching(std::size_t shape) const { return normal_[shape] > 0; }
  void look()
  {
    peak_.assign(shapes_, 0.0);
    began_.assign(shapes_, std::numeric_limits<double>::quiet_NaN());
  }

  // Start at rest, with the propellers at given speeds.
  void reset(const Vector &q, const double *speeds)
  {
    mj_resetData(model_.get(), data_.get());
    for (const auto &base : given_.rows("base")) {
      const std::size_t from = std::size_t(base[0]);
      mjtNum *to = data_->qpos + int(base[1]);
      mju_copy(to, &q[from], 3);
      to[3] = q[from + 6];
      mju_copy(to + 4, &q[from + 3], 3);
    }
    for (const auto &joint : given_.rows("joint")) {
      data_->qpos[int(joint[1])] = q[std::size_t(joint[0])];
    }
    speeds_.assign(speeds, speeds + rotors_);
    force_ = {};
    normal_.assign(shapes_, 0.0);
    forces_.assign(shapes_, {});
    look();
    push_end_ = steps_ = 0;
    past_.clear();
    mj_step1(model_.get(), data_.get());
    sample();
  }

  // Apply a force to a point of a body from now on.
  void push(int body, std::array<double, 3> point, std::array<double, 3> force, double seconds)
  {
    push_body_ = body;
    push_point_ = point;
    push_force_ = force;
    push_end_ = steps_ + std::lround(seconds / timestep());
  }

  const Reading &measured() const { return past_.front(); }
  const Reading &truth() const { return past_.back(); }

  // Simulate physics steps with one command.  Return whether the state is finite and has not diverged.
  bool step(const double *rotor_speed, const double *torque, int count)
  {
    const Vector &effort = given_.row("effort", 0);
    for (std::size_t j = 0; j < effort.size(); ++j) {
      data_->ctrl[rotors_ + j] = std::fmin(std::fmax(torque[j], -effort[j]), effort[j]);
    }
    for (int k = 0; k < count; ++k) {
      if (rotors_) {
        const Vector &law = given_.row("rotor_law", 5);
        for (std::size_t i = 0; i < rotors_; ++i) {
          const double away = std::fmin(std::fmax(rotor_speed[i], law[3]), law[4]) - speeds_[i];
          speeds_[i] += (away > 0 ? law[0] : law[1]) * away;
          data_->ctrl[i] = law[2] * speeds_[i] * speeds_[i];
        }
      }
      apply_push();
      mj_step2(model_.get(), data_.get());
      ++steps_;
      log_contacts();
      if (feels()) {
        const auto &felt = forces_.at(std::size_t(given_.number("force_shape")));
        for (int i = 0; i < 3; ++i) {
          force_[i] += smoothing_ * (felt[i] - force_[i]);
        }
      }
      mj_step1(model_.get(), data_.get());
      sample();
    }
    return mju_norm(data_->qvel, model_->nv) < 1e6 && mju_norm(data_->qpos, model_->nq) < 1e6;
  }

private:
  void apply_push()
  {
    mju_zero(data_->qfrc_applied, model_->nv);
    if (push_end_ <= steps_) {
      return;
    }
    mjtNum point[3], zero[3] = {};
    mju_mulMatVec3(point, data_->xmat + 9 * push_body_, push_point_.data());
    mju_addTo3(point, data_->xpos + 3 * push_body_);
    mj_applyFT(model_.get(), data_.get(), push_force_.data(), zero, point, push_body_, data_->qfrc_applied);
  }

  // MuJoCo names the plane of a contact first, so that the contact pushes the second geom.
  void log_contacts()
  {
    normal_.assign(shapes_, 0.0);
    forces_.assign(shapes_, {});
    for (int c = 0; c < data_->ncon; ++c) {
      const mjContact &contact = data_->contact[c];
      if (contact.efc_address < 0) {
        continue;
      }
      const int one = shape_of_[std::size_t(contact.geom[0])], other = shape_of_[std::size_t(contact.geom[1])];
      if (one < 0 && other < 0) {
        continue; // the links of an MJCF touch each other
      }
      const std::size_t shape = std::size_t(one > other ? one : other);
      mjtNum force[3], local[3] = {};
      mju_copy(local, data_->efc_force + contact.efc_address, contact.dim == 3 ? 3 : 1);
      mju_mulMatTVec3(force, contact.frame, local);
      for (std::size_t i = 0; i < 3; ++i) {
        forces_[shape][i] += other >= 0 ? force[i] : -force[i];
      }
      normal_[shape] += local[0];
    }
    for (std::size_t s = 0; s < shapes_; ++s) {
      peak_[s] = std::fmax(peak_[s], normal_[s]);
      if (normal_[s] > 0 && std::isnan(began_[s])) {
        began_[s] = data_->time - timestep();
      }
    }
  }

  void sample()
  {
    Reading now{Vector(given_.row("q").size()), Vector(std::size_t(model_->nv)), force_};
    for (const auto &base : given_.rows("base")) {
      const mjtNum *from = data_->qpos + int(base[1]), *rate = data_->qvel + int(base[3]);
      double *q = &now.q[std::size_t(base[0])], *v = &now.v[std::size_t(base[2])];
      mjtNum unit[4], back[4];
      mju_copy4(unit, from + 3);
      mju_normalize4(unit);
      mju_negQuat(back, unit);
      mju_copy3(q, from);
      mju_copy3(q + 3, unit + 1);
      q[6] = unit[0];
      mju_rotVecQuat(v, rate, back);
      mju_copy3(v + 3, rate + 3);
    }
    for (const auto &joint : given_.rows("joint")) {
      now.q[std::size_t(joint[0])] = data_->qpos[int(joint[1])];
      now.v[std::size_t(joint[2])] = data_->qvel[int(joint[3])];
    }
    past_.push_back(now);
    if (past_.size() > 1 + std::size_t(given_.number("delay"))) {
      past_.pop_front();
    }
  }

  const Parameters &given_;
  std::unique_ptr<mjModel, void (*)(mjModel *)> model_;
  std::unique_ptr<mjData, void (*)(mjData *)> data_;
  std::vector<int> shape_of_;
  std::size_t shapes_ = 0, rotors_ = 0;
  double smoothing_ = 0;
  Vector speeds_, normal_, peak_, began_;
  std::vector<std::array<double, 3>> forces_;
  std::array<double, 3> force_{}, push_point_{}, push_force_{};
  int push_body_ = 0;
  long push_end_ = 0, steps_ = 0;
  std::deque<Reading> past_;
};

#endif
