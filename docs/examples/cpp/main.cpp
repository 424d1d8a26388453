// Repeatedly reads q, v, q_des, n, Kp, Kd, K from standard input.  Prints the posture acceleration, or the error code
// if it does not exist.  A controller needs only the call of posture_acceleration in the loop.
#include "posture_acceleration.hpp"

#include <cstdio>
#include <iostream>

template <class Vector>
bool read(Vector &x)
{
  for (int i = 0; i < x.size(); ++i) {
    std::cin >> x[i];
  }
  return bool(std::cin);
}

int main()
{
  impact::Configuration q, q_des;
  impact::Tangent v, a;
  impact::Vector3 n, gains;
  while (read(q) && read(v) && read(q_des) && read(n) && read(gains)) {
    const int code = impact::posture_acceleration(q, v, q_des, n, {gains[0], gains[1], gains[2]}, a);
    if (code == 1 || code == 2) {
      std::printf("code %d\n", code);
      continue;
    }
    for (int i = 0; i < a.size(); ++i) {
      std::printf("%.17g%c", double(a[i]), i + 1 < a.size() ? ' ' : '\n');
    }
  }
  return 0;
}
