#!/usr/bin/env bash
# Makes pimper_torch/result/report/three.js anew: what the page of a run uses of three.js, in one file.
set -euo pipefail
page="$(cd "$(dirname "$0")/../../pimper_torch/viz/report" && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
cd "$work"
npm install --silent --no-fund --no-audit three@0.187.0 esbuild@0.28.2
cat > entry.js <<'ENTRY'
export {
  AmbientLight, BufferGeometry, Color, Float32BufferAttribute, Group, LightProbe,
  LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshNormalMaterial,
  MeshPhysicalMaterial, PerspectiveCamera, PointLight, Points, PointsMaterial, Raycaster, Scene,
  Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
ENTRY
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --target=es2022 \
    --legal-comments=eof --outfile="$page/three.js"
cp node_modules/three/LICENSE "$page/three.LICENSE"
