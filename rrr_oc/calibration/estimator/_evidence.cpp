// The evidence of a linear problem and its best hyperparameters, from products of its columns: see `rrr_oc.calibration.estimator.evidence`, whose
// names are used here. A search asks for it thousands of times, on matrices so small that numpy's calls would take most of the time.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace {

using Matrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = Eigen::VectorXd;
using Index = Eigen::Index;
template <class T>
using In = Eigen::Map<const T>;

constexpr double REGULAR = 1e-12;  // of a diagonal of 1, against a matrix that is singular but for rounding; if need be more
constexpr double CANCELLED = 1e-13;  // share of a square that rounding may leave where features take all of it
constexpr double LEAST_NOISE = 1e-6;  // share of the residual at the start below which no noise is estimated: it would be rounding
constexpr int TOGETHER = 10;  // steps to bounds in which all that lie wrong change at once; afterwards one by one, which must end

struct Held
{
  std::vector<Py_buffer> views;
  ~Held() { for (Py_buffer & v : views) PyBuffer_Release(&v); }
  void * get(PyObject * object, bool writable, Py_ssize_t elements)
  {
    Py_buffer view;
    if (PyObject_GetBuffer(object, &view, PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0))) return nullptr;
    views.push_back(view);
    if (view.len == elements * 8) return view.buf;
    PyErr_Format(PyExc_ValueError, "expected %zd numbers, got a buffer of %zd bytes", elements, view.len);
    return nullptr;
  }
};

struct Joint
{
  Index m, features;  // columns that are not 0 and features of the discrepancy
  const double *xx, *xy, *tx, *ty, *values;
  const std::int64_t * live;
  double yy, log_det, count;
};

struct Prior
{
  In<Vector> mean, precision, proper, links, lower, upper, flat;
  Index link(Index i) const { return static_cast<Index>(links[i]) - 1; }  // whose error a parameter is; −1 of others
};

struct Normal
{
  Matrix likelihood;
  std::vector<Matrix> own;  // of each joint
  Vector right, precision;
  double misfit;
};

// A Cholesky factor of a precision, scaled to a diagonal of 1.
struct Factor
{
  Vector scale;
  Eigen::LLT<Eigen::MatrixXd> root;
  explicit Factor(const Eigen::MatrixXd & matrix)
  {
    scale = matrix.diagonal().unaryExpr([](double x) { return x > 0 ? std::sqrt(x) : 1.0; });
    const Eigen::MatrixXd scaled = scale.cwiseInverse().asDiagonal() * matrix * scale.cwiseInverse().asDiagonal();
    const Eigen::MatrixXd unit = Eigen::MatrixXd::Identity(scaled.rows(), scaled.cols());
    for (double more = REGULAR; more < 1; more *= 100)
    {
      root.compute(scaled + more * unit);
      if (root.info() == Eigen::Success) break;
    }
  }
  Vector solve(const Vector & right) const { return root.solve(right.cwiseQuotient(scale)).cwiseQuotient(scale); }
  Eigen::MatrixXd inverse() const
  {
    const Index p = scale.size();
    return scale.cwiseInverse().asDiagonal() * root.solve(Eigen::MatrixXd::Identity(p, p)) * scale.cwiseInverse().asDiagonal();
  }
  double log_det() const { return 2 * (root.matrixLLT().diagonal().array().log().sum() + scale.array().log().sum()); }
};

Normal normal(const std::vector<Joint> & joints, const double * sigma, const double * discrepancy, const double * links, const Prior & prior)
{
  const Index p = prior.mean.size();
  Normal n{Matrix::Zero(p, p), {}, Vector::Zero(p), prior.precision, 0.0};
  for (Index i = 0; i < p; ++i)
    if (const Index link = prior.link(i); link >= 0) n.precision[i] /= links[link] * links[link];
  for (std::size_t j = 0; j < joints.size(); ++j)
  {
    const Joint & one = joints[j];
    const double sigma2 = sigma[j] * sigma[j], rho = sigma2 / (discrepancy[j] * discrepancy[j]);
    const Vector root = (In<Vector>(one.values, one.features).array() + rho).rsqrt();
    const Matrix tx = root.asDiagonal() * In<Matrix>(one.tx, one.features, one.m);
    const Vector ty = root.cwiseProduct(In<Vector>(one.ty, one.features));
    Matrix xx = In<Matrix>(one.xx, one.m, one.m);
    const Vector rounded = CANCELLED * xx.diagonal();
    // Eigen divides by the number of features where it chooses the sizes of blocks
    if (tx.size() > 0) xx.selfadjointView<Eigen::Lower>().rankUpdate(tx.transpose(), -1.0);
    xx.triangularView<Eigen::StrictlyUpper>() = xx.transpose();
    xx.diagonal() += rounded;
    xx /= sigma2;
    const Vector xy = (In<Vector>(one.xy, one.m) - tx.transpose() * ty) / sigma2;
    for (Index a = 0; a < one.m; ++a)
    {
      n.right[one.live[a]] += xy[a];
      for (Index b = 0; b < one.m; ++b) n.likelihood(one.live[a], one.live[b]) += xx(a, b);
    }
    n.misfit += (one.yy - ty.squaredNorm()) / sigma2;
    n.own.push_back(std::move(xx));
  }
  return n;
}

// argmin ½ xᵀ H x − gᵀ x within bounds, by principal pivoting: of what lies beyond a bound or is drawn back from one, all change, and if
// that does not end, the last (Murty's rule, which ends where H is positive definite).
Vector within(const Matrix & h, const Factor & root, const Vector & g, const Prior & prior)
{
  const Index p = g.size();
  Vector x = root.solve(g);
  if ((x.array() >= prior.lower.array()).all() && (x.array() <= prior.upper.array()).all()) return x;
  std::vector<int> at(p, 0);  // −1 and 1 at the lower and upper bound
  for (int step = 0; step < TOGETHER + 4 * static_cast<int>(p); ++step)
  {
    const Vector slope = h * x - g;
    std::vector<std::pair<Index, int>> wrong;
    for (Index i = 0; i < p; ++i)
      if (at[i] == 0 && x[i] < prior.lower[i]) wrong.emplace_back(i, -1);
      else if (at[i] == 0 && x[i] > prior.upper[i]) wrong.emplace_back(i, 1);
      else if (prior.lower[i] < prior.upper[i] && ((at[i] < 0 && slope[i] < 0) || (at[i] > 0 && slope[i] > 0))) wrong.emplace_back(i, 0);
    if (wrong.empty()) return x;
    if (step >= TOGETHER) wrong.erase(wrong.begin(), wrong.end() - 1);
    for (const auto & [i, to] : wrong) at[i] = to;
    std::vector<Index> free;
    for (Index i = 0; i < p; ++i)
      if (at[i] == 0) free.push_back(i);
      else x[i] = at[i] < 0 ? prior.lower[i] : prior.upper[i];
    if (free.empty()) continue;
    Vector held = x, right(free.size());
    for (Index i : free) held[i] = 0.0;
    const Vector pulled = g - h * held;
    Eigen::MatrixXd inside(free.size(), free.size());
    for (std::size_t a = 0; a < free.size(); ++a)
    {
      right[a] = pulled[free[a]];
      for (std::size_t b = 0; b < free.size(); ++b) inside(a, b) = h(free[a], free[b]);
    }
    const Vector found = Factor(inside).solve(right);
    for (std::size_t a = 0; a < free.size(); ++a) x[free[a]] = found[a];
  }
  return x.cwiseMax(prior.lower).cwiseMin(prior.upper);
}

// The size x that maximises −squares / 2 x² − known log x − x² / 2.
double best_size(double squares, double known, double least)
{
  return std::max(std::sqrt((std::sqrt(known * known + 4 * squares) - known) / 2), least);
}

struct Sizes
{
  double *sigma, *discrepancy, *links;
};

// One step of the hyperparameters towards those of the largest evidence (MacKay's fixed point), given the covariance of the parameters; what the
// step gains [nats], about: the largest squared change of the logarithm of a size times the numbers that it is estimated from, infinite where errors of a link
// change by a tenth.
double update(
  const std::vector<Joint> & joints, const Normal & n, const Eigen::MatrixXd & inverse, const Vector & step, const Sizes & sizes,
  const Prior & prior, double least)
{
  double change = 0.0;
  for (std::size_t j = 0; j < joints.size(); ++j)
  {
    const Joint & one = joints[j];
    const double old = sizes.sigma[j], s = sizes.discrepancy[j], rho = old * old / (s * s);
    const In<Vector> values(one.values, one.features);
    const In<Matrix> tx(one.tx, one.features, one.m), xx(one.xx, one.m, one.m);
    const Vector weights = (values.array() + rho).inverse();
    Vector d(one.m);
    Eigen::MatrixXd own(one.m, one.m);
    for (Index a = 0; a < one.m; ++a)
    {
      d[a] = step[one.live[a]];
      for (Index b = 0; b < one.m; ++b) own(a, b) = inverse(one.live[a], one.live[b]);
    }
    const Vector t = In<Vector>(one.ty, one.features) - tx * d, c = weights.cwiseProduct(t);
    Matrix through = Matrix::Zero(one.m, one.m);
    if (tx.size() > 0) through.selfadjointView<Eigen::Lower>().rankUpdate((weights.asDiagonal() * tx).transpose());
    through.diagonal() /= 2;
    const double spread = 2 * through.triangularView<Eigen::Lower>().toDenseMatrix().cwiseProduct(own).sum() / (s * s);
    const double used = std::max(values.dot(weights) - spread, 0.0), taken = n.own[j].cwiseProduct(own).sum();
    const double squares =
      one.yy - 2 * In<Vector>(one.xy, one.m).dot(d) + d.dot(xx * d) - 2 * c.dot(t) + c.dot(values.cwiseProduct(c));
    const double rows = std::max({one.count - used - taken, one.count / 2, 1.0});
    const double floor = std::max(LEAST_NOISE * std::sqrt(one.yy / std::max(one.count, 1.0)), 1e-9);
    sizes.sigma[j] = std::max(std::sqrt(std::max(squares, 0.0) / rows), floor);
    sizes.discrepancy[j] = best_size(c.squaredNorm(), used, least);
    const double by_size = std::pow(std::log(sizes.discrepancy[j] / s), 2) * used;
    change = std::max({change, by_size, std::pow(std::log(sizes.sigma[j] / old), 2) * one.count});
  }
  Vector squares = Vector::Zero(joints.size()), known = squares;
  for (Index i = 0; i < step.size(); ++i)
    if (const Index link = prior.link(i); link >= 0)
    {
      squares[link] += prior.precision[i] * (step[i] - prior.mean[i]) * (step[i] - prior.mean[i]);
      known[link] += 1 - n.precision[i] * inverse(i, i);
    }
  for (Index k = 0; k < squares.size(); ++k)
  {
    const double old = sizes.links[k];
    sizes.links[k] = std::max(std::sqrt(squares[k] / (std::max(known[k], 0.0) + 1)), 1.0);
    if (std::abs(std::log(sizes.links[k] / old)) >= 0.1) change = std::numeric_limits<double>::infinity();
  }
  return change;
}

double log_evidence(const std::vector<Joint> & joints, const Normal & n, const Vector & step, const Sizes & sizes, const Prior & prior)
{
  const Vector off = step - prior.mean;
  double cost = n.misfit - 2 * n.right.dot(step) + step.dot(n.likelihood * step) + off.dot(n.precision.cwiseProduct(off));
  Eigen::MatrixXd volume = n.likelihood;
  volume.diagonal() += n.precision + prior.flat;
  double log = -0.5 * cost - 0.5 * Factor(volume).log_det();
  for (Index i = 0; i < step.size(); ++i)
    if (prior.proper[i] != 0) log += 0.5 * std::log(n.precision[i] + prior.flat[i]);
  for (std::size_t j = 0; j < joints.size(); ++j)
  {
    const double s2 = sizes.discrepancy[j] * sizes.discrepancy[j], share = s2 / (sizes.sigma[j] * sizes.sigma[j]);
    log += joints[j].log_det - joints[j].count * std::log(sizes.sigma[j]) - 0.5 * s2;
    for (Index f = 0; f < joints[j].features; ++f) log -= 0.5 * std::log1p(joints[j].values[f] * share);
    log -= std::log(sizes.links[j]);  // the chance that errors of a link are x times the declared ones or more is 1 / x
  }
  return log;
}

bool read(PyObject * list, Held & held, std::vector<Joint> & joints)
{
  for (Py_ssize_t j = 0; j < PyTuple_GET_SIZE(list); ++j)
  {
    Joint one;
    Py_ssize_t m, features;
    PyObject *xx, *xy, *tx, *ty, *values, *live;
    if (!PyArg_ParseTuple(
          PyTuple_GET_ITEM(list, j), "nnOOOOOOddd", &m, &features, &xx, &xy, &tx, &ty, &values, &live, &one.yy, &one.log_det, &one.count))
      return false;
    one.m = m, one.features = features;
    const auto get = [&held](PyObject * object, Py_ssize_t size) { return static_cast<const double *>(held.get(object, false, size)); };
    if (!(one.xx = get(xx, m * m)) || !(one.xy = get(xy, m)) || !(one.tx = get(tx, features * m))) return false;
    if (!(one.ty = get(ty, features)) || !(one.values = get(values, features))) return false;
    if (!(one.live = static_cast<const std::int64_t *>(held.get(live, false, m)))) return false;
    joints.push_back(one);
  }
  return true;
}

PyObject * py_estimate(PyObject *, PyObject * args)
{
  Py_ssize_t p;
  int updates;
  double settled, least;
  PyObject *list, *arrays[7], *sizes, *step, *matrix, *likelihood, *right;
  if (!PyArg_ParseTuple(
        args, "nO!OOOOOOOOiddOOOO", &p, &PyTuple_Type, &list, arrays, arrays + 1, arrays + 2, arrays + 3, arrays + 4, arrays + 5,
        arrays + 6, &sizes, &updates, &settled, &least, &step, &matrix, &likelihood, &right))
    return nullptr;
  Held held;
  std::vector<Joint> joints;
  if (!read(list, held, joints)) return nullptr;
  const double * of_prior[7];
  for (int k = 0; k < 7; ++k)
    if (!(of_prior[k] = static_cast<const double *>(held.get(arrays[k], false, p)))) return nullptr;
  const auto vector = [&of_prior, p](int k) { return In<Vector>(of_prior[k], p); };
  const Prior prior{vector(0), vector(1), vector(2), vector(3), vector(4), vector(5), vector(6)};
  const Py_ssize_t n = static_cast<Py_ssize_t>(joints.size());
  double * const size = static_cast<double *>(held.get(sizes, true, 3 * n));
  double * out[4];
  PyObject * const to[4] = {step, matrix, likelihood, right};
  const Py_ssize_t lengths[4] = {p, p * p, p * p, p};
  if (!size) return nullptr;
  for (int k = 0; k < 4; ++k)
    if (!(out[k] = static_cast<double *>(held.get(to[k], true, lengths[k])))) return nullptr;
  double log = 0.0, misfit = 0.0;
  Py_BEGIN_ALLOW_THREADS;
  const Sizes at{size, size + n, size + 2 * n};
  for (int k = 0;; ++k)
  {
    const Normal now = normal(joints, at.sigma, at.discrepancy, at.links, prior);
    Matrix whole = now.likelihood;
    whole.diagonal() += now.precision;
    const Factor root(whole);
    const Vector best = within(whole, root, now.right + now.precision.cwiseProduct(prior.mean), prior);
    if (k < updates)
    {
      if (update(joints, now, root.inverse(), best, at, prior, least) < settled) updates = k + 1;
      continue;
    }
    log = log_evidence(joints, now, best, at, prior), misfit = now.misfit;
    Eigen::Map<Vector>(out[0], p) = best;
    Eigen::Map<Matrix>(out[1], p, p) = whole;
    Eigen::Map<Matrix>(out[2], p, p) = now.likelihood;
    Eigen::Map<Vector>(out[3], p) = now.right;
    break;
  }
  Py_END_ALLOW_THREADS;
  return Py_BuildValue("dd", log, misfit);
}

PyMethodDef methods[] = {
  {"estimate", py_estimate, METH_VARARGS,
   "estimate(p, joints, mean, precision, proper, links, lower, upper, flat, sizes, updates, settled, least, step, matrix, likelihood, "
   "right) -> log evidence, misfit: see `rrr_oc.calibration.estimator.evidence`."},
  {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_evidence", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__evidence() { return PyModule_Create(&module); }
