// Pinocchio's algorithms on casadi::SX, for installations whose `pinocchio` has no `casadi` submodule.
//
// chain_functions(placements, axes) -> {name: serialized casadi::Function}
// One revolute joint a link; gravity and all ten inertial parameters of every link are inputs, so the functions
// depend on the kinematics alone. The Python twin, for installations that have `pinocchio.casadi`, is in
// rigid_body.py and hands back the same functions.
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <pinocchio/autodiff/casadi.hpp>

#include <pinocchio/multibody.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include <map>
#include <string>
#include <vector>

namespace {

using SX = casadi::SX;

// The chains here have one kind of joint; Pinocchio's default collection of 25 would only lengthen the build.
template<typename Scalar_, int Options_>
struct RevoluteJoints
{
  typedef Scalar_ Scalar;
  static constexpr int Options = Options_;
  typedef pinocchio::JointModelRevoluteUnalignedTpl<Scalar, Options> JointModelRevoluteUnaligned;
  typedef pinocchio::JointDataRevoluteUnalignedTpl<Scalar, Options> JointDataRevoluteUnaligned;
  typedef pinocchio::JointModelMimicTpl<Scalar, Options, RevoluteJoints> JointModelMimic;
  typedef pinocchio::JointDataMimicTpl<Scalar, Options, RevoluteJoints> JointDataMimic;
  typedef boost::variant<JointModelRevoluteUnaligned, boost::recursive_wrapper<JointModelMimic>> JointModelVariant;
  typedef boost::variant<JointDataRevoluteUnaligned, boost::recursive_wrapper<JointDataMimic>> JointDataVariant;
};

using Model = pinocchio::ModelTpl<SX, 0, RevoluteJoints>;
using Data = pinocchio::DataTpl<SX, 0, RevoluteJoints>;
using Vector = Model::ConfigVectorType;

Vector to_eigen(const SX & x)
{
  Vector v(x.numel());
  for (casadi_int i = 0; i < x.numel(); ++i) v[i] = x(i);
  return v;
}

template<typename Derived>
SX to_casadi(const Eigen::MatrixBase<Derived> & m)
{
  SX x(m.rows(), m.cols());
  for (Eigen::Index i = 0; i < m.rows(); ++i)
    for (Eigen::Index j = 0; j < m.cols(); ++j) x(i, j) = m(i, j);
  return x;
}

Model chain(const std::vector<double> & placements, const std::vector<double> & axes, const SX & inertial, const SX & gravity)
{
  Model model;
  const std::size_t n = axes.size() / 3;
  for (std::size_t i = 0; i < n; ++i)
  {
    const double * T = &placements[12 * i];  // row-major 3x4: rotation and translation in the parent's joint frame
    Model::SE3::Matrix3 R;
    Model::SE3::Vector3 p, axis;
    for (int r = 0; r < 3; ++r)
    {
      for (int c = 0; c < 3; ++c) R(r, c) = T[4 * r + c];
      p[r] = T[4 * r + 3];
      axis[r] = axes[3 * i + r];
    }
    const auto joint = model.addJoint(
      i, pinocchio::JointModelRevoluteUnalignedTpl<SX, 0>(axis), Model::SE3(R, p), "joint" + std::to_string(i));
    Eigen::Matrix<SX, 10, 1> pi;
    for (int r = 0; r < 10; ++r) pi[r] = inertial(r, static_cast<casadi_int>(i));
    model.inertias[joint] = Model::Inertia::FromDynamicParameters(pi);
  }
  model.gravity.linear() = to_eigen(gravity);
  return model;
}

std::map<std::string, std::string>
chain_functions(const std::vector<double> & placements, const std::vector<double> & axes)
{
  const casadi_int n = static_cast<casadi_int>(axes.size() / 3);
  const SX q = SX::sym("q", n), dq = SX::sym("dq", n), ddq = SX::sym("ddq", n), tau = SX::sym("tau", n);
  const SX inertial = SX::sym("inertial", 10, n), gravity = SX::sym("gravity", 3);
  const Model model = chain(placements, axes, inertial, gravity);
  const Vector q_ = to_eigen(q), dq_ = to_eigen(dq), ddq_ = to_eigen(ddq), tau_ = to_eigen(tau);

  std::map<std::string, std::string> functions;
  const auto add = [&functions](
                     const std::string & name, const std::vector<SX> & in, const std::vector<std::string> & names,
                     const SX & out) {
    functions[name] = casadi::Function(name, in, {out}, names, {"out"}).serialize();
  };

  Data mass_data(model);
  pinocchio::crba(model, mass_data, q_);
  mass_data.M.triangularView<Eigen::StrictlyLower>() = mass_data.M.transpose().triangularView<Eigen::StrictlyLower>();
  add("mass_matrix", {q, inertial}, {"q", "inertial"}, to_casadi(mass_data.M));

  Data coriolis_data(model);
  add("coriolis_matrix", {q, dq, inertial}, {"q", "dq", "inertial"},
      to_casadi(pinocchio::computeCoriolisMatrix(model, coriolis_data, q_, dq_)));

  Data gravity_data(model);
  add("gravity_torque", {q, inertial, gravity}, {"q", "inertial", "gravity"},
      to_casadi(pinocchio::computeGeneralizedGravity(model, gravity_data, q_)));

  Data inverse_data(model);
  add("inverse_dynamics", {q, dq, ddq, inertial, gravity}, {"q", "dq", "ddq", "inertial", "gravity"},
      to_casadi(pinocchio::rnea(model, inverse_data, q_, dq_, ddq_)));

  Data forward_data(model);
  add("forward_dynamics", {q, dq, tau, inertial, gravity}, {"q", "dq", "tau", "inertial", "gravity"},
      to_casadi(pinocchio::aba(model, forward_data, q_, dq_, tau_)));

  Data kinematic_data(model);
  pinocchio::forwardKinematics(model, kinematic_data, q_);
  SX frames(12, n);  // column i: joint i's rotation (column-major) and origin in the base frame
  for (casadi_int i = 0; i < n; ++i)
  {
    const auto & frame = kinematic_data.oMi[i + 1];
    for (int c = 0; c < 3; ++c)
      for (int r = 0; r < 3; ++r) frames(3 * c + r, i) = frame.rotation()(r, c);
    for (int r = 0; r < 3; ++r) frames(9 + r, i) = frame.translation()[r];
  }
  add("joint_frames", {q}, {"q"}, frames);
  return functions;
}

bool to_vector(PyObject * object, std::vector<double> & values)
{
  PyObject * sequence = PySequence_Fast(object, "expected a sequence of floats");
  if (!sequence) return false;
  for (Py_ssize_t i = 0; i < PySequence_Fast_GET_SIZE(sequence); ++i)
    values.push_back(PyFloat_AsDouble(PySequence_Fast_GET_ITEM(sequence, i)));
  Py_DECREF(sequence);
  return !PyErr_Occurred();
}

PyObject * py_chain_functions(PyObject *, PyObject * args)
{
  PyObject *placements_object, *axes_object;
  std::vector<double> placements, axes;
  if (!PyArg_ParseTuple(args, "OO", &placements_object, &axes_object)) return nullptr;
  if (!to_vector(placements_object, placements) || !to_vector(axes_object, axes)) return nullptr;
  if (axes.empty() || axes.size() % 3 || placements.size() != 4 * axes.size())
    return PyErr_Format(PyExc_ValueError, "expected 12 numbers of placement and 3 of axis a joint, got %zu and %zu",
                        placements.size(), axes.size());
  try
  {
    PyObject * result = PyDict_New();
    for (const auto & [name, text] : chain_functions(placements, axes))
    {
      PyObject * value = PyUnicode_FromStringAndSize(text.data(), static_cast<Py_ssize_t>(text.size()));
      PyDict_SetItemString(result, name.c_str(), value);
      Py_XDECREF(value);
    }
    return result;
  }
  catch (const std::exception & error)
  {
    PyErr_SetString(PyExc_RuntimeError, error.what());
    return nullptr;
  }
}

PyMethodDef methods[] = {
  {"chain_functions", py_chain_functions, METH_VARARGS,
   "chain_functions(placements, axes): serialized casadi.Functions of a serial chain of revolute joints."},
  {nullptr, nullptr, 0, nullptr}};

PyModuleDef module = {PyModuleDef_HEAD_INIT, "_rigid_body", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__rigid_body() { return PyModule_Create(&module); }
